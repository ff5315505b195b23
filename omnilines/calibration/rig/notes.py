"""What a person should know of the calibration of a rig, one sentence each."""

import math
from collections.abc import Mapping

import torch

from camera_models.formats.camera_doubts import model_doubts
from camera_models.wording import rounded
from omnilines.calibration.diagnose import coverage_notes
from omnilines.calibration.intervals import few_notes
from omnilines.calibration.rig.against_alone import AgainstAlone
from omnilines.calibration.rig.clocks import offsets_note
from omnilines.calibration.rig.excess import excess_note
from omnilines.calibration.rig.links import Link
from omnilines.calibration.rig.outcome import RigOutcome
from omnilines.calibration.rig.result import RigMember
from omnilines.calibration.table_doubts import misfit_notes, size_notes
from omnilines.calibration.unmodelled import Unmodelled
from omnilines.least_squares import Outcome


def rig_notes(
    outcome: RigOutcome,
    members: tuple[RigMember, ...],
    weakest: Link | None,
    left_out: Mapping[str, str],
    against: AgainstAlone,
    other: Unmodelled | None,
) -> tuple[str, ...]:
    """What a person should know of a rig, the most important first."""
    notes = [f"Camera {name} is not of the rig: {reason}." for name, reason in left_out.items()]
    notes += [f"Camera {member.name}: {member.chosen}" for member in members if member.chosen]
    notes += [f"Camera {member.name}: {member.misfit.note(member.follows)}" for member in members if member.misfit is not None]
    notes += [f"Camera {member.name}: {member.other.note}" for member in members if member.other is not None]
    notes += against.notes
    offsets = offsets_note(outcome)
    notes += [*(() if offsets is None else (offsets,)), *outcome.clock_notes, *outcome.line_notes]
    sizes = {member.name: member.model.image_size for member in members}
    notes += [f"Camera {delay.camera}: {delay.note(sizes[delay.camera])}" for delay in outcome.line_delays]
    notes += outcome.notes
    views, doubt = outcome.data.views, outcome.thresholds.doubt
    notes += size_notes(torch.as_tensor(views.corners.board_m), doubt)
    if weakest is not None:
        first, second = members[weakest.first].name, members[weakest.second].name
        notes.append(
            f"The weakest link of the rig is {first} - {second}: {weakest.corners} common corners in {weakest.frames} frames; "
            f"their relative rotation is known to {rounded(weakest.rotation_sigma_deg)} degrees and their translation to "
            f"{rounded(1e3 * weakest.translation_sigma_m)} mm (one standard deviation)."
        )
    for k, member in enumerate(members):
        if k in outcome.worse:
            notes.append(
                f"Camera {member.name} fits the rig worse than alone: {member.rms_px_per_point:.3g} px instead of "
                f"{member.alone_rms_px_per_point:.3g} px per point; {AS_HELD if outcome.worse_as_held else CHECK}."
            )
        own = outcome.fit.points.camera[outcome.fit.points.view] == k
        pixels = outcome.fit.points.pixels[own]
        rms_px, stated_px = member.rms_px_per_point / math.sqrt(2), outcome.data.noise[k].sigma_px
        notes += [f"Camera {member.name}: {note}" for note in misfit_notes(rms_px, member.model.image_size, stated_px, doubt)]
        notes += [f"Camera {member.name}: {note}." for note in model_doubts(member.model, estimated=k not in outcome.held)]
        notes += [f"Camera {member.name}: {note}" for note in coverage_notes(member.model, pixels, member.model.image_size)]
    notes += () if other is None else (other.note,)
    notes += _excess_notes(outcome)
    notes += _noise_notes(outcome, members)
    lost = ~outcome.fit.kept
    if outcome.rejects and bool(lost.any()):
        notes.append(
            f"{int(lost.sum())} of {len(lost)} corners were rejected: they lie more than "
            f"{outcome.thresholds.robust.reject_sigma:g} robust standard deviations from where the rig sees them."
        )
    if outcome.solution.outcome is not Outcome.CONVERGED:
        notes.append(outcome.solution.outcome.value)
    return tuple(notes)


CHECK = "check that all cameras see the same instant and that the board is flat"
AS_HELD = "that comes from the calibrations that are held, not from the board"


def _excess_notes(outcome: RigOutcome) -> list[str]:
    """Why the rig fits worse than its cameras alone, or frames contradict each other, and what that does to the standard
    deviations."""
    found = outcome.contradiction
    if found is not None:
        return [
            f"Frames contradict each other {rounded(found.ratio)} times as much as the noise of their corners explains "
            f"({'chi-square' if outcome.factor.holds else 'F'} test): a board that bends or is not flat, a model "
            f"{'or a calibration that is held ' if outcome.held else ''}that does not suit, or blur moves all corners of a photo "
            "together. The standard deviations hold that."
        ]
    if not outcome.worse:
        return []
    cause = excess_note(outcome.data, outcome.fit, outcome.solution, outcome.held, outcome.thresholds.rig)
    told = [cause] if cause else []
    factors = outcome.frame_factors
    if factors is not None and len(factors):
        told.append(
            "Frames contradict each other by more than the noise of their corners: the estimate is "
            f"{rounded(float(factors.median()))} times (at most {rounded(float(factors.max()))} times) as uncertain as that "
            "alone would "
            "make it, as leaving out each frame in turn shows; the standard deviations hold that."
        )
    return told


def _noise_notes(outcome: RigOutcome, members: tuple[RigMember, ...]) -> tuple[str, ...]:
    """Cameras whose corners are other than stated, and that there are few."""
    thresholds = outcome.thresholds.noise
    if outcome.data.views.corners.sigma_px is None:
        return few_notes(outcome.factor, thresholds.large_freedom)
    told = []
    for member, noise in zip(members, outcome.data.noise, strict=True):
        stated = f"from where it sees them as their stated {noise.stated_px:.3g} px explain"
        if noise.sigma_px > noise.stated_px:
            told.append(
                f"Camera {member.name}: corners lie {noise.sigma_px / noise.stated_px:.3g} times as far {stated} (chi-square "
                "test): the standard deviations follow the residuals."
            )
        elif noise.found_px < thresholds.well_below_share * noise.stated_px:
            told.append(
                f"Camera {member.name}: corners lie only {rounded(noise.found_px / noise.stated_px)} times as far {stated}: they "
                "count in the rig as little as is stated, and the standard deviations are on the safe side."
            )
    return tuple(told)
