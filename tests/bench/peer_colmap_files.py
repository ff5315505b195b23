"""pycolmap reads and writes a folder, run by .venv-peers: what it makes of the cameras and the rig as JSON on standard output."""

import json
import sys
from pathlib import Path

import numpy as np
import pycolmap


def main() -> None:
    """Arguments: folder to read, folder to write as text and binary (may be -), rays as JSON (n x 3)."""
    folder, out, rays = Path(sys.argv[1]), sys.argv[2], np.array(json.loads(sys.argv[3]))
    scene = pycolmap.Reconstruction()
    binary = (folder / "cameras.bin").is_file()
    for name in ("frames", "images", "points3D"):
        (folder / f"{name}.{'bin' if binary else 'txt'}").write_bytes(bytes(8) if binary else b"")
    (scene.read_binary if binary else scene.read_text)(str(folder))
    cameras = {
        key: {
            "model": camera.model_name,
            "params": list(camera.params),
            "size": [camera.width, camera.height],
            "pixels": np.asarray(camera.img_from_cam(rays)).tolist(),
        }
        for key, camera in scene.cameras.items()
    }
    poses = {}
    for rig in scene.rigs.values():
        for sensor in rig.non_ref_sensors:
            poses[sensor.id] = np.asarray(rig.sensor_from_rig(sensor).matrix()).tolist()
    if out != "-":
        for kind in ("text", "binary"):
            target = Path(out) / kind
            target.mkdir(parents=True)
            (scene.write_text if kind == "text" else scene.write_binary)(str(target))
    print(json.dumps({"cameras": cameras, "poses": poses}))


if __name__ == "__main__":
    main()
