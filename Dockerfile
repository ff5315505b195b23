# omnilines with its compiled functions in place: docker build -t omnilines . && docker run --rm -v "$PWD:/data" omnilines --help
# `make demo` and `doctor` are run while the image is built: an image that is there has calibrated a camera and rebuilt lines.
FROM python:3.12-slim

# make for `make demo`; OpenMP's library for wheels that do not bring their own.
RUN apt-get update && apt-get install -y --no-install-recommends make libgomp1 && rm -rf /var/lib/apt/lists/*

WORKDIR /opt/omnilines
COPY pyproject.toml constraints.txt Makefile README.md LICENSE THIRD_PARTY.md CHANGELOG.md ./
COPY camera_models camera_models
COPY calib_patterns calib_patterns
COPY omnilines omnilines

# torch for processors: PyPI's brings NVIDIA's libraries, which are larger than all else together.
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu \
    PIP_NO_CACHE_DIR=1 \
    NUMBA_CACHE_DIR=/opt/omnilines/compiled
RUN make demo && .venv/bin/omnilines doctor && rm -rf demo && chmod -R a+rwX /opt/omnilines/compiled

ENV PATH=/opt/omnilines/.venv/bin:$PATH
WORKDIR /data
ENTRYPOINT ["omnilines"]
CMD ["--help"]
