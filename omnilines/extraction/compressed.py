"""Photos that lost edges before they came: a coarse JPEG rounds weak ones away, and moves the others."""

from collections.abc import Mapping

from omnilines.extraction.options import ExtractionOptions


def coarse_jpegs_note(quality: Mapping[str, int | None], options: ExtractionOptions) -> tuple[str, ...]:
    """A sentence on the photos that are JPEG of low quality; `quality` is that of each (`jpeg_quality`), by name."""
    coarse = {name: own for name, own in quality.items() if own is not None and own < options.coarse_jpeg_quality}
    if not coarse:
        return ()
    least = min(coarse, key=lambda name: coarse[name])
    return (
        f"{len(coarse)} of {len(quality)} photos are JPEG of low quality ({least}: {coarse[least]} of 100): fewer edges are "
        "found, and less precisely. Give the originals, of a quality of 90 or more.",
    )
