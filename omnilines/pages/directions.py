"""Directions of photos: figures for tables and `--json`, the report, and pictures with the arcs of each direction."""

import math
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import torch
from jaxtyping import UInt8

from camera_models.wording import rounded
from omnilines.pages.arcs import COLOURS, draw_arcs, write_drawn
from omnilines.pages.limits_of_lines import directions_advice
from omnilines.pipelines.directions import FoundDirections, PhotoDirections, Wanted
from omnilines.pipelines.photo_arcs import FoundArcs
from omnilines.progress import ProgressCallback
from omnilines.records import Summary
from omnilines.report import Section, pictures_section, table_section, verdict_section


def directions_summary(found: PhotoDirections) -> Summary:
    """A row for each photo that was used."""
    rows = tuple((one.arcs.photo.name, _row(one)) for one in found.photos)
    some = sum(len(one) > 0 for one in found.photos)
    notes = (f"a {found.wanted.value} in {some} of {len(rows)} photos",)
    advice = directions_advice(found)
    return Summary("Directions", rows, notes, of_photos=True, verdict=directions_verdict(found), advice=advice)


def directions_verdict(found: PhotoDirections) -> str:
    """What was found, in one sentence."""
    some = [one for one in found.photos if len(one)]
    count = f"{len(some)} of {len(found.photos)} photos"
    if not some:
        return f"No {found.wanted.value} stands out from chance in any of {len(found.photos)} photos."
    sigma = math.degrees(float(np.median(np.concatenate([one.meeting.sigma_rad for one in some]))))
    tilts = [math.degrees(tilt) for one in some if (tilt := one.tilt_rad) is not None]
    tilted = f"; they are tilted by {rounded(np.median(tilts))} degrees (median), {rounded(max(tilts))} at most" if tilts else ""
    each = [len(one) for one in some]
    what = f"A {found.wanted.value} stands" if found.wanted is not Wanted.ALL else f"{_range(each)} directions of lines stand"
    return f"{what} out from chance in {count}, known to {rounded(sigma)} degrees (median){tilted}."


def _range(counts: list[int]) -> str:
    return str(counts[0]) if min(counts) == max(counts) else f"{min(counts)} to {max(counts)}"


def directions_sections(found: PhotoDirections) -> list[Section]:
    """The sections of report.html: the verdict, a table of the directions of each photo, and the photos with their arcs."""
    of_photo = {one.arcs.photo.name: one for one in found.photos}
    head = ("Photo", "Direction", "#x", "#y", "#z", "#Its sigma (°)", "#Arcs", "#Arcs of the photo", "#Stray (°)", "#Tilt (°)")
    rows = [row for one in found.photos for row in (_table_rows(one) or [(one.arcs.photo.name, "none", *[""] * 8)])]
    text = (
        "Unit vectors of the camera frame (x right, y down, z forward), with their largest standard deviation. Stray is by how "
        "much lines differ from their direction beyond what the noise of their arcs explains, one figure for all of a photo."
    )
    said = (
        "Arcs in the colours of their directions, named in the corner, grey for none; a ring where a direction, or the "
        "one opposite, is seen."
    )
    return [
        verdict_section(directions_summary(found)),
        pictures_section(list(of_photo), lambda name: draw_directions(found, of_photo[name]), said, "Photos"),
        table_section("Directions", head, rows, (text,), [one.text for one in found.details]),
    ]


def _table_rows(one: FoundDirections) -> list[tuple[str, ...]]:
    """A row for each direction; what is said of the photo as a whole stands in its first."""
    tilt = "" if one.tilt_rad is None else f"{math.degrees(one.tilt_rad):.2f}"
    whole = (f"{len(one.arcs):,}", rounded(math.degrees(one.meeting.stray_rad)), tilt)
    each = zip(one.names, one.meeting.direction.tolist(), np.degrees(one.meeting.sigma_rad), one.meeting.members, strict=True)
    return [
        (one.arcs.photo.name, name, *(f"{c:.4f}" for c in xyz), rounded(sigma), f"{arcs:,}", *(("", "", "") if k else whole))
        for k, (name, xyz, sigma, arcs) in enumerate(each)
    ]


def _row(one: FoundDirections) -> str:
    if not len(one):
        return "none"
    arcs = ", ".join(f"{name}: {count}" for name, count in zip(one.names, one.meeting.members.tolist(), strict=True))
    sigma = np.degrees(one.meeting.sigma_rad)
    known = rounded(sigma.min()) if len(sigma) == 1 else f"{rounded(sigma.min())} to {rounded(sigma.max())}"
    tilt = "" if one.tilt_rad is None else f", tilted by {math.degrees(one.tilt_rad):.2f} degrees"
    return f"arcs of {arcs} (of {len(one.arcs)}), known to {known} degrees{tilt}"


def directions_data(found: PhotoDirections) -> dict[str, Any]:
    """What `--json` prints."""
    photos = [
        {
            "image": one.arcs.photo.name,
            "camera": one.arcs.camera,
            "arcs": len(one.arcs),
            "stray_deg": math.degrees(one.meeting.stray_rad) if len(one) else None,
            "tilt_deg": None if one.tilt_rad is None else math.degrees(one.tilt_rad),
            "directions": [
                {"name": name, "xyz": direction.tolist(), "sigma_deg": math.degrees(sigma), "arcs": int(count)}
                for name, direction, sigma, count in zip(
                    one.names, one.meeting.direction, one.meeting.sigma_rad, one.meeting.members, strict=True
                )
            ],
        }
        for one in found.photos
    ]
    return {"wanted": found.wanted.value, "photos": photos, "skipped": found.arcs.skipped}


def write_direction_pictures(folder: Path, found: PhotoDirections, progress: ProgressCallback) -> tuple[Path, ...]:
    """A JPEG of each photo that was used with its arcs in the colours of their directions, and a ring where one is seen."""
    of_photo = {one.arcs.photo.name: one for one in found.photos}

    def drawn(arcs: FoundArcs) -> UInt8[np.ndarray, "h w 3"]:
        """The picture of one photo."""
        return draw_directions(found, of_photo[arcs.photo.name])

    return write_drawn(folder, found.arcs.used, drawn, progress)


def draw_directions(found: PhotoDirections, one: FoundDirections) -> UInt8[np.ndarray, "h w 3"]:
    """The photo of some directions with its arcs; both sides of a direction have a ring where the photo shows them, and its name
    stands in its colour in the corner."""
    model = found.arcs.cameras[one.arcs.camera]
    picture = draw_arcs(one.arcs.photo.read(), model, one.arcs, one.meeting.direction_of)
    radius = max(4, max(model.image_size) // 100)
    for k, (name, direction) in enumerate(zip(one.names, one.meeting.direction, strict=True)):
        for colour, width in (((0, 0, 0), 4), (COLOURS[k % len(COLOURS)], 2)):
            corner = (2 * radius, 4 * (k + 1) * radius)
            cv2.putText(picture, name, corner, cv2.FONT_HERSHEY_SIMPLEX, radius / 8, colour, width, cv2.LINE_AA)
        for side in (direction, -direction):
            pixel, seen = model.project(torch.as_tensor(side))
            u, v = pixel.detach().tolist()
            if bool(seen) and 0 <= u < model.image_size[0] and 0 <= v < model.image_size[1]:
                cv2.circle(picture, (round(u), round(v)), radius, COLOURS[k % len(COLOURS)], 2, cv2.LINE_AA)
    return picture
