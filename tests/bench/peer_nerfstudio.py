"""Nerfstudio's own parsers read a COLMAP folder or transforms.json, run by .venv-peers: its cameras and rays as JSON.

They need no CUDA: `pip install --no-deps nerfstudio==1.1.5`, and with their dependencies torch, rich,
tyro, viser==0.2.7, jaxtyping, tensorboard, opencv-python-headless, appdirs, requests, rawpy and matplotlib.
"""

import json
import sys
from pathlib import Path

import torch
from nerfstudio.data.dataparsers.colmap_dataparser import ColmapDataParserConfig
from nerfstudio.data.dataparsers.nerfstudio_dataparser import NerfstudioDataParserConfig

AS_IT_IS = {"orientation_method": "none", "center_method": "none", "auto_scale_poses": False, "eval_mode": "all"}


def main() -> None:
    """Arguments: folder or file, pixels as JSON (n x 2, from the corner of the image)."""
    data, pixels = Path(sys.argv[1]), torch.tensor(json.loads(sys.argv[2]))
    if data.is_dir():
        config = ColmapDataParserConfig(data=data, colmap_path=Path("sparse/0"), downscale_factor=1, **AS_IT_IS)
    else:
        config = NerfstudioDataParserConfig(data=data, downscale_factor=1, **AS_IT_IS)
    outputs = config.setup().get_dataparser_outputs(split="train")
    # Without its own turns and scale, but for an exchange of axes: back to the world of the file.
    back = torch.linalg.inv(torch.cat([outputs.dataparser_transform, torch.tensor([[0.0, 0.0, 0.0, 1.0]])]).double())
    found = {}
    for index, name in enumerate(outputs.image_filenames):
        rays = outputs.cameras.generate_rays(
            torch.full((len(pixels), 1), index), coords=pixels.flip(-1), keep_shape=False, disable_distortion=False
        )
        directions = rays.directions.double() @ back[:3, :3].T
        found[name.name] = {
            "type": int(outputs.cameras.camera_type[index]),
            "centre": (back[:3, :3] @ rays.origins[0].double() + back[:3, 3]).tolist(),
            "directions": directions.tolist(),
        }
    points = outputs.metadata.get("points3D_xyz")
    print(json.dumps({"frames": found, "points": 0 if points is None else len(points)}))


if __name__ == "__main__":
    main()
