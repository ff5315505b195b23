"""The pictures of the walks and of the first page, from what the walks have written.

python docs/scripts/walks.py FOLDER         # runs the walks
python docs/scripts/pictures.py FOLDER      # needs Debian's chromium and playwright
"""

import sys
from pathlib import Path

import cv2
import matplotlib
import matplotlib.pyplot as plt
import numpy as np
from playwright.sync_api import sync_playwright

import omnilines as ol

PICTURES = Path(__file__).resolve().parents[1] / "pictures"
FLAGS = ["--no-sandbox", "--use-gl=angle", "--use-angle=swiftshader", "--enable-unsafe-swiftshader"]
"""WebGL without a GPU."""
REPORTS = {
    "walk_fisheye_map": ("fisheye/result", "Projection uncertainty"),
    "walk_rig": ("rig/result", "The rig"),
    "walk_room": ("room/scene", "Scene"),
}
"""Picture -> folder of results, heading of the section of its report."""
COLOURS = ("#c1453c", "#2a7fbf", "#3b8f4e", "#8a8a8a")
"""Of lines along x, y, z and of others."""


def shoot(folder: Path) -> None:
    """The plots of the reports."""
    with sync_playwright() as playwright:
        browser = playwright.chromium.launch(executable_path="/usr/bin/chromium", args=FLAGS)
        page = browser.new_page(viewport={"width": 900, "height": 900}, color_scheme="light")
        for name, (place, heading) in REPORTS.items():
            page.goto((folder / place / "report.html").resolve().as_uri())
            page.wait_for_selector("html[data-plots=drawn]", timeout=120_000)
            plot = page.locator("section", has=page.get_by_role("heading", name=heading, exact=True)).locator(".plot").first
            plot.scroll_into_view_if_needed()
            page.wait_for_timeout(5000)
            save(PICTURES / f"{name}.png", cv2.imdecode(np.frombuffer(plot.screenshot(), np.uint8), cv2.IMREAD_COLOR))
        browser.close()


def save(path: Path, image: np.ndarray) -> None:
    """A PNG that is as small as it can be."""
    cv2.imwrite(str(path), image, [cv2.IMWRITE_PNG_COMPRESSION, 9])


def photo_with_arcs(folder: Path) -> np.ndarray:
    """A photo of the room with its arcs, (h, w, 3) RGB."""
    camera = ol.load(folder / "photos" / "calibration.yaml")["cam0"]
    photo = cv2.imread(str(folder / "photos" / "view03.png"))
    for ends in ol.extract({"view03.png": photo}, camera).segments.endpoints_px:
        bearings, _ = camera.unproject(ends)
        share = np.linspace(0.0, 1.0, 32)[:, None]
        pixels, _ = camera.project((1.0 - share) * bearings[0] + share * bearings[1])
        cv2.polylines(photo, [np.round(16.0 * pixels).astype(np.int32)], False, (60, 200, 255), 1, cv2.LINE_AA, 4)
    return cv2.cvtColor(photo, cv2.COLOR_BGR2RGB)


def draw_first_page(folder: Path) -> None:
    """A photo with its arcs beside the rebuilt lines and the cameras."""
    lines, poses = ol.read_lines(folder / "scene" / "lines.csv"), ol.read_poses(folder / "scene" / "poses.csv")
    matplotlib.use("Agg")
    figure = plt.figure(figsize=(10.0, 4.4), dpi=110)
    left = figure.add_axes((0.0, 0.0, 0.44, 1.0))
    left.imshow(photo_with_arcs(folder))
    left.set_axis_off()
    right = figure.add_axes((0.42, -0.12, 0.6, 1.24), projection="3d")
    for start, end in lines.ends_m[lines.known]:
        along = np.abs(end - start) / np.linalg.norm(end - start)
        colour = COLOURS[int(along.argmax())] if along.max() > 0.99 else COLOURS[3]
        right.plot(*np.stack([start, end]).T, color=colour, linewidth=0.9)
    centres = poses.cam_from_world.centre.numpy()
    right.scatter(*centres.T, color="#e08a1e", s=14)
    right.set_box_aspect(np.ptp(lines.ends_m[lines.known].reshape(-1, 3), axis=0), zoom=1.05)
    right.view_init(elev=32, azim=-58)
    right.set_axis_off()
    figure.savefig(PICTURES / "room.jpg", facecolor="white", pil_kwargs={"quality": 88})


def beside(first: Path, second: Path, name: str, *, below: bool = False) -> None:
    """Two images as one picture, side by side or one below the other, as large as the smaller of them there."""
    images = [cv2.imread(str(path)) for path in (first, second)]
    side = min(image.shape[1 if below else 0] for image in images)
    scales = [side / image.shape[1 if below else 0] for image in images]
    sized = [cv2.resize(image, None, fx=k, fy=k, interpolation=cv2.INTER_AREA) for image, k in zip(images, scales, strict=True)]
    cv2.imwrite(str(PICTURES / f"{name}.jpg"), (cv2.vconcat if below else cv2.hconcat)(sized), [cv2.IMWRITE_JPEG_QUALITY, 85])


if __name__ == "__main__":
    walks = Path(sys.argv[1])
    beside(walks / "field/photos/view03.png", walks / "field/level/view03.png", "walk_field")
    beside(walks / "camera360/board/view01.png", walks / "camera360/panorama/view01.png", "walk_camera360", below=True)
    photo = cv2.imread(str(walks / "fisheye/photos/view01.png"))
    cv2.imwrite(str(PICTURES / "walk_fisheye_photo.jpg"), photo, [cv2.IMWRITE_JPEG_QUALITY, 85])
    draw_first_page(walks / "room")
    shoot(walks)
