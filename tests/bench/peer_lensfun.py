"""lensfun reads a file of one lens, run by .venv-peers: where it finds the pixels of a panorama in the photo, as JSON."""

import json
import sys

import lensfunpy


def main() -> None:
    """Arguments: file, width, height, every how many pixels. The panorama has the focal length and the centre of the lens."""
    path, (width, height, step) = sys.argv[1], map(int, sys.argv[2:5])
    (lens,) = lensfunpy.Database(paths=[path], load_common=False, load_bundled=False).lenses
    modifier = lensfunpy.Modifier(lens, lens.crop_factor, width, height)
    modifier.initialize(lens.min_focal, 8.0, 1000.0, 1.0, lensfunpy.LensType.EQUIRECTANGULAR)
    found = modifier.apply_geometry_distortion()[::step, ::step]
    print(json.dumps({"type": lens.type.name, "pixels": found.tolist()}))


if __name__ == "__main__":
    main()
