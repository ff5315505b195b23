"""omnilines export: a scene folder -> a file or folder of another tool."""

from pathlib import Path

from omnilines.commands.result import CommandResult
from omnilines.pipelines.export import export as pipeline
from omnilines.records import Summary


def export(
    scene: Path,
    out: Path,
    *,
    to_format: str | None = None,
    photos: Path | None = None,
    origin: tuple[float, float, float] | None = None,
) -> CommandResult:
    """Read the scene, write it, and say what was fitted or lost. Raises InputError as `pipelines.export.export` does."""
    made = pipeline(scene, out, to_format=to_format, photos=photos, origin=origin)
    files, lost = made.save()
    lines, poses = int(made.scene.lines.known.sum()), len(made.scene.poses)
    rows = (("lines", f"{lines}, in {made.scene.lines.unit.words}"), ("photos", str(poses)), ("written", str(out)))
    data = {"format": made.writer.name, "lines": lines, "photos": poses, "lost": list(lost)}
    note = f"{out}: not kept, or changed: {'; '.join(one.rstrip('.') for one in lost)}."
    return CommandResult((Summary(f"Scene -> {made.writer.title}", rows),), data, files=files, warnings=(note,))
