"""The contract of a file format of calibrations: what it holds exactly, and how it is read and written."""

import os
from abc import ABC, abstractmethod
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, ClassVar

import torch

from camera_models._model import CameraModel
from camera_models.errors import InputError
from camera_models.formats.calibration_data import Calibration, CameraEstimate, RigCamera, ViewRecord
from camera_models.formats.camera_check import check_cameras
from camera_models.formats.disk import staged, write_atomically
from camera_models.formats.forms import Form
from camera_models.pose import Pose
from camera_models.wording import listed

Documents = dict[Path, str | bytes]
"""Content of every file to be written."""
DEFAULT_NAME = "cam0"
"""Name of a camera whose file has no place for one."""
SAME_FRAME = 1e-12
"""Poses (m, and entries of the rotation matrix) that differ by less are the same."""


@dataclass(frozen=True)
class Content:
    """What was read from a file."""

    calibration: Calibration
    notes: tuple[str, ...] = ()
    """What the file holds beside, or says in a way that a reader should know of; one sentence each."""


@dataclass(frozen=True)
class Nearly:
    """What a file says of a camera beside its parameters, and only nearly."""

    what: str
    """In messages."""
    off_px: float
    """The largest error."""
    angles_deg: tuple[float, float] | None
    """The angles off axis within which that is so; None for all that the image sees."""
    begins: bool = False
    """Whether its tools only begin there, and come to what is exact from it."""


class CalibrationFormat(ABC):
    """One file format. `read` and `write` are complete: what has no place on the other side is refused or named in a note."""

    NAME: ClassVar[str]
    """On the command line."""
    TITLE: ClassVar[str]
    """In messages."""
    SUFFIXES: ClassVar[tuple[str, ...]]
    """Of its files; the first is written where a folder gets a file for each camera."""
    FORMS: ClassVar[tuple[Form, ...]]
    """From the fewest parameters to the most for each model: the first that holds a camera exactly is written."""
    RIGS: ClassVar[bool] = False
    """Whether it says where the cameras of a rig stand."""
    TOGETHER: ClassVar[bool] = True
    """Whether one file may hold several cameras; where not, a folder gets a file for each."""
    NEEDS_RIG: ClassVar[bool] = False
    """Whether a file of several cameras must say where they stand."""
    FOLDERS: ClassVar[bool] = False
    """Whether a folder is one calibration for the tool itself."""
    REFERRED: ClassVar[bool] = True
    """Whether the first camera is made the frame of a rig when it is read."""
    KEEPS: ClassVar[frozenset[str]] = frozenset()
    """Fields of `CameraEstimate`, and `views` and `provenance` of `Calibration`, for which a file of one camera has a place."""

    @abstractmethod
    def recognises(self, path: Path, head: str) -> bool:
        """Whether a file is of this format, by its name and the first 64 KiB of it (as Latin-1 text)."""

    @abstractmethod
    def _read(self, path: Path, image_size: tuple[int, int] | None) -> Content:
        """One file; its rig in whatever frame the file has. `image_size` stands in for a size that the file leaves out."""

    @abstractmethod
    def _documents(self, path: Path, calibration: Calibration) -> Documents:
        """Every file that is written for one file name; the calibration is one that the format holds."""

    def names(self, calibration: Calibration) -> list[str]:
        """Names under which a reader finds the cameras of one file; the default is cam0, cam1, ..."""
        return [f"cam{index}" for index in range(len(calibration))]

    def keeps(self, path: Path, calibration: Calibration) -> frozenset[str]:
        """What stays of a calibration written to a path, in the words of KEEPS, and `rig`."""
        alone = is_folder(path) and not self.FOLDERS
        several = len(calibration) > 1 and not alone
        return (frozenset() if several else self.KEEPS) | (frozenset({"rig"}) if self.RIGS and not alone else frozenset())

    def nearly(self, calibration: Calibration) -> dict[str, Nearly]:
        """What its own tools work with, or begin with, beside the exact parameters, where that is off, by camera; the default is
        nothing."""
        return {}

    def forms_at(self, path: Path, calibration: Calibration) -> tuple[Form, ...]:
        """The forms that a camera of a calibration written to a path may have; the default is all."""
        return self.FORMS

    @classmethod
    def form_of(cls, model: CameraModel) -> Form | None:
        """The form that holds a camera exactly, None where none does."""
        return next((form for form in cls.FORMS if form.why_not(model) is None), None)

    @classmethod
    def exact_form(cls, model: CameraModel) -> Form:
        """`form_of` where there is one; raises InputError where not."""
        form = cls.form_of(model)
        if form is None:
            raise InputError(
                f"{cls.TITLE} was expected to hold the camera, found that {cls.why_not(model)}; fit another model to it."
            )
        return form

    @classmethod
    def form_named(cls, name: str, where: str) -> Form:
        """The form of a name found in a file; raises InputError where it is none of them."""
        for form in cls.FORMS:
            if form.name == name:
                return form
        known = ", ".join(dict.fromkeys(form.name for form in cls.FORMS))
        raise InputError(
            f"The camera model of {where} must be one with a counterpart here ({known}), found {name}; convert it to one of "
            f"these with {cls.TITLE}."
        )

    @classmethod
    def why_not(cls, model: CameraModel) -> str | None:
        """Why no file of the format holds a camera exactly, as the end of a sentence; None where one does."""
        if cls.form_of(model) is not None:
            return None
        # The last form of the model is the one with the most parameters.
        near = [form.why_not(model) for form in cls.FORMS if form.model == model.NAME]
        return near[-1] if near else f"it has no camera model {model.NAME}"

    def read(self, path: str | Path, image_size: tuple[int, int] | None = None) -> Content:
        """A file, or a folder of files with a camera each; the first camera is the frame of the rig.

        Raises InputError with the file, what was expected in it and what was found.
        """
        file = Path(path)
        try:
            if not file.is_dir() or self.FOLDERS:
                content = self._read(file, image_size)
            else:
                content = _joined({part: self._read(part, image_size) for part in self._files(file)})
            check_cameras(content.calibration)
            return _referred_to_first(content) if self.REFERRED else content
        except InputError as error:
            raise error if str(file) in str(error) else InputError(f"{file}: {error}") from None

    def _files(self, folder: Path) -> list[Path]:
        found = sorted(part for part in folder.iterdir() if part.suffix.lower() in self.SUFFIXES and part.is_file())
        if not found:
            raise InputError(f"{folder}: files ending in {' or '.join(self.SUFFIXES)} were expected, found none; name the file.")
        return found

    def documents(self, path: str | Path, calibration: Calibration) -> Documents:
        """Every file that `write` makes, without making it.

        Raises InputError where the format does not hold a camera exactly (fit it first), several cameras go to a file of one, or
        it needs to know where the cameras stand.
        """
        target = Path(path)
        for name, model in calibration.items():
            if not bool(torch.isfinite(model.parameters).all()):
                raise InputError(f"The parameters of camera {name} must be finite, found {model!r}; calibrate it again.")
            reason = self.why_not(model)
            if reason is not None:
                raise InputError(
                    f"{self.TITLE} was expected to hold camera {name}, found that {reason}; fit another model to it."
                )
        if not is_folder(target) or self.FOLDERS:
            self._check_several(target, calibration)
            return self._documents(target, calibration)
        whole: Documents = {}
        for name in calibration:
            if not name.strip(".") or any(character in name for character in '/\\:*?"<>|'):
                raise InputError(f"The name of a camera was expected to be fit for a file name, found '{name}'; rename it.")
            rig = {name: calibration.rig[name]} if calibration.rig else {}
            estimates = {name: calibration.estimates[name]} if name in calibration.estimates else {}
            views = tuple(view for view in calibration.views if view.camera == name)
            part = Calibration({name: calibration[name]}, estimates, rig, views, calibration.provenance)
            whole |= self._documents(target / f"{name}{self.SUFFIXES[0]}", part)
        return whole

    def _check_several(self, target: Path, calibration: Calibration) -> None:
        several = len(calibration) > 1
        if several and not self.TOGETHER:
            expected, found = "one camera for one file", f"{len(calibration)} ({listed(calibration)})"
        elif several and self.NEEDS_RIG and not calibration.rig:
            expected, found = "to know where the cameras stand", "no rig"
        else:
            return
        raise InputError(
            f"{self.TITLE} expects {expected}, found {found} for {target}; give a folder, which gets a file for each camera."
        )

    def write(self, path: str | Path, calibration: Calibration) -> list[Path]:
        """Write a calibration, every file in one step; returns the files. Raises InputError as `documents` does."""
        documents = self.documents(path, calibration)
        for folder in {file.parent for file in documents if os.path.abspath(file) not in staged}:
            try:
                folder.mkdir(parents=True, exist_ok=True)
            except OSError as error:
                raise InputError(f"The folder {folder} cannot be made ({error.strerror}); give another path.") from None
        for file, content in documents.items():
            write_atomically(file, content)
        return list(documents)


def is_folder(path: Path) -> bool:
    """Whether a path is a folder, or will be: one that does not exist and has no suffix."""
    return path.is_dir() or (not path.suffix and not path.exists())


def _joined(parts: Mapping[Path, Content]) -> Content:
    """The cameras of several files, each named after its file."""
    cameras: dict[str, CameraModel] = {}
    estimates: dict[str, CameraEstimate] = {}
    rig: dict[str, RigCamera] = {}
    views: list[ViewRecord] = []
    made_of: dict[str, Any] = {}
    notes: list[str] = []
    for path, content in parts.items():
        if len(content.calibration) > 1:
            raise InputError(f"{path}: one camera was expected in each file of a folder, found several; name the file alone.")
        if path.stem in cameras:
            raise InputError(f"{path}: one file was expected for each camera, found two called {path.stem}; remove one.")
        ((own, model),) = content.calibration.items()
        cameras[path.stem] = model
        if own in content.calibration.estimates:
            estimates[path.stem] = content.calibration.estimates[own]
        if own in content.calibration.rig:
            rig[path.stem] = content.calibration.rig[own]
        views += [replace(view, camera=path.stem) for view in content.calibration.views]
        made_of |= {path.stem: content.calibration.provenance} if content.calibration.provenance else {}
        notes += [f"{path.name}: {note}" for note in content.notes]
    # All cameras in one place is what files say where the poses are not known.
    known = len(rig) == len(cameras) and any(_off(item.cam_from_rig) > SAME_FRAME for item in rig.values())
    whole = Calibration(cameras, estimates, rig if known else {}, tuple(views), made_of)
    return Content(whole, tuple(notes))


def _referred_to_first(content: Content) -> Content:
    """The same with the first camera as the frame of the rig; a frame that is lost by that is named."""
    calibration = content.calibration
    if not calibration.rig:
        return content
    name = next(iter(calibration))
    first = calibration.rig[name].cam_from_rig
    off = _off(first)
    notes = content.notes
    if off > SAME_FRAME:
        # Adding 0.0 turns -0.0 into 0.0.
        x, y, z = (first.centre + 0.0).tolist()
        notes = (
            *notes,
            f"The file has a frame of its own, in which camera {name} stands at ({x:.6g}, {y:.6g}, {z:.6g}) m; "
            "here the first camera is the frame of the rig, and that pose is not kept.",
        )
    if len(calibration) == 1:
        return Content(replace(calibration, rig={}), notes)
    if off == 0:
        return content
    rig_from_first = first.inverse()
    rig = {other: replace(item, cam_from_rig=item.cam_from_rig @ rig_from_first) for other, item in calibration.rig.items()}
    return Content(replace(calibration, rig=rig | {name: RigCamera(Pose.identity())}), notes)


def _off(pose: Pose) -> float:
    """How far a pose is from the identity."""
    return max(float((pose.rotation - torch.eye(3)).abs().max()), float(pose.translation.abs().max()))


HAS_POSES = "Poses of photos are not kept: --poses of reconstruct takes the same file."
"""Of files that have them beside cameras, and that are read for them too."""


def left_out(beside: Mapping[str, Iterable[str]]) -> tuple[str, ...]:
    """Notes on the keys of each camera that have no place here, one for all cameras that have the same."""
    cameras: dict[str, list[str]] = {}
    for name, keys in beside.items():
        found = listed(keys)
        if found:
            cameras.setdefault(found, []).append(name)
    return tuple(f"Not kept of {listed(names)}: {keys}." for keys, names in cameras.items())
