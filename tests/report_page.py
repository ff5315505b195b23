"""A page with every section of a report, its photos, and how its parts are read."""

import pathlib

import cv2
import numpy as np

from camera_models.pose import Pose
from omnilines import report
from omnilines.records import Check, ImagePoses, Lines, Polyline, Segments, Summary, ViewResult

SIZE = (1032, 778)


def residual_case(n: int = 900, seed: int = 3) -> tuple[np.ndarray, np.ndarray, np.ndarray, list[str]]:
    rng = np.random.default_rng(seed)
    pixels = rng.uniform(0, 1, (n, 2)) * (np.array(SIZE) - 1)
    return pixels, 0.3 * rng.normal(size=(n, 2)), rng.integers(0, 5, n), [f"view {k}" for k in range(5)]


def uncertainty_case() -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """A map that grows from 0.01 px in the middle by 1000 times, with unknown corners of the image, and its columns and rows."""
    u, v = np.linspace(0, SIZE[0] - 1, 44), np.linspace(0, SIZE[1] - 1, 33)
    radius = np.hypot(*np.meshgrid(u - 515.5, v - 388.5))
    return np.where(radius < 600, 0.01 * 1000 ** (radius / 600) ** 2, np.nan), u, v


def some_lines() -> Lines:
    ends = np.array([[[0.1 * k, 0.0, 0.0], [0.1 * k, 0.4, 0.0]] for k in range(5)])
    ends[4] = np.nan
    status = ("ok", "ok", "ok", "weak", "epipolar")
    names = tuple(f"track {k}" for k in range(5))
    return Lines(names, ends, np.full(5, 7), np.full(5, 0.25), np.full(5, 0.0012), status)


def some_segments() -> Segments:
    """Track 2 in the wide photo and in one that cannot be read, track 0 in the small one, and an arc of no track."""
    tracks = tuple(f"track {k}" for k in range(5))
    image, track = np.array([0, 2, 1, 1, 0]), np.array([2, 2, 0, -1, 2])
    return Segments(image, ("wide.jpg", "small.png", "broken.jpg"), track, tracks, np.zeros((5, 2, 2)))


def camera_ring(n: int) -> ImagePoses:
    """Cameras on a circle of radius 1 m at height 1 m that look at the origin."""
    poses = []
    for angle in np.linspace(0, 2 * np.pi, n, endpoint=False):
        centre = np.array([np.cos(angle), np.sin(angle), 1.0])
        z = -centre / np.linalg.norm(centre)
        x = np.cross(z, [0.0, 0.0, 1.0])
        x /= np.linalg.norm(x)
        rotation = np.stack([x, np.cross(z, x), z])
        poses.append(Pose.of(rotation, -rotation @ centre))
    return ImagePoses(tuple(f"photo {k}" for k in range(n)), Pose.stack(poses))


def every_section(photo_folder: pathlib.Path, curves: list[Polyline]) -> list[report.Section]:
    pixels, residuals, view, names = residual_case()
    theta = np.linspace(0, 95, 96)
    phase = np.linspace(0, 2 * np.pi, 73)
    circle = np.stack([515.5 + 380 * np.cos(phase), 388.5 + 380 * np.sin(phase)], 1)
    board = np.array([[0.0, 0, 0], [0.4, 0, 0], [0.4, 0.5, 0], [0.0, 0.5, 0]])
    views = [ViewResult("view 0", "a.jpg", True, None, 48, 1, 0.31), ViewResult("view 1", "b.jpg", False, "no board was found.")]
    return [
        report.summary_section(Summary("Result", (("rms_px_per_axis", "0.30 px"),), ("A note.",))),
        report.checks_section((Check("bearing error", 0.0123, 0.02, "degrees", True), Check("photos lost", 2.0, 1.0, "", False))),
        report.parameters_section("pinhole", ["fx", "k1"], np.array([500.0, -1e-3]), np.array([0.2, 2e-5])),
        report.views_section(views),
        report.residual_section(pixels, residuals, SIZE, view, names),
        report.coverage_section(pixels, SIZE, circle, supported_angle_deg=82.4),
        report.uncertainty_section(*uncertainty_case(), SIZE, circle, corners_px=pixels, supported_angle_deg=82.4),
        report.radial_section(theta, 300 * np.deg2rad(theta), supported_angle_deg=82.4),
        report.histogram_section(
            "Before and after", {"before": np.abs(residuals[:, 0]) * 9, "after": np.abs(residuals[:, 0])}, "px"
        ),
        report.curve_section("Cost", {"sector": (np.arange(5.0), 10.0 ** -np.arange(5))}, "iteration", "cost", logarithmic=True),
        report.photos_section(photo_folder, curves),
        report.scene_section(
            boards=[("board", board)],
            lines=some_lines(),
            groups=["rows"] * 3 + ["columns"] * 2,
            cameras=camera_ring(8),
            truth_m=some_lines().ends_m[:4],
            segments=some_segments(),
        ),
    ]


def write_photos(folder: pathlib.Path) -> pathlib.Path:
    """A wide photo with one bright disc, a small one, and a file that is no photo."""
    wide = np.full((2001, 3203, 3), 20, np.uint8)
    cv2.circle(wide, (2310, 405), 90, (255, 255, 255), -1, cv2.LINE_AA)
    cv2.imwrite(str(folder / "wide.jpg"), wide)
    cv2.imwrite(str(folder / "small.png"), np.full((300, 400, 3), 128, np.uint8))
    (folder / "broken.jpg").write_bytes(b"not a photo")
    return folder


def curves_on_photos() -> list[Polyline]:
    gap = np.array([[10.0, 10.0], [60.0, 12.0], [np.nan, np.nan], [100.0, 14.0], [150.0, 20.0]])
    return [
        Polyline("wide.jpg", np.array([[2310.0, 405.0]]), "disc", "observed"),
        Polyline("wide.jpg", np.array([[2200.0, 405.0], [2420.0, 405.0]]), "across the disc"),
        Polyline("small.png", gap, "<row & column>"),
        Polyline("broken.jpg", np.array([[1.0, 1.0]]), "", "observed"),
        Polyline("absent.jpg", np.array([[1.0, 1.0]]), "", "observed"),
    ]


def write_every_section(path: pathlib.Path, photos: pathlib.Path) -> pathlib.Path:
    """A page with all of it."""
    return report.write_report(path, 'Calibration of "cam0" <test>', every_section(photos, curves_on_photos()))
