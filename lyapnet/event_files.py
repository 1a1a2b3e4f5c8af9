"""TensorBoard event files: cut back where a run resumes, and read."""

import io
from collections.abc import Iterator
from pathlib import Path

from tensorboard.backend.event_processing.event_file_loader import RawEventFileLoader
from tensorboard.compat.proto.event_pb2 import Event  # pyright: ignore[reportAttributeAccessIssue]
from tensorboard.summary.writer.record_writer import RecordWriter

from lyapnet.atomic import write_atomically


def drop_events_after(folder: Path, step: int) -> None:
    """Remove what a run logged after a step, so that going on from that step logs nothing twice.

    The final metrics (tags hp/ and _hparams_) go too: the end of the run writes them again.
    """
    for path in event_files(folder):
        kept = io.BytesIO()
        records = RecordWriter(kept)
        for record in RawEventFileLoader(str(path)).Load():
            if _keep(Event.FromString(record), step):
                records.write(record)
        write_atomically(path, kept.getbuffer())


def curve(folder: Path, tag: str) -> list[tuple[float, int, float]]:
    """(seconds since the Epoch, step, value) of a run's scalar."""
    return [
        (event.wall_time, event.step, value.simple_value)
        for path in event_files(folder)
        for event in map(Event.FromString, RawEventFileLoader(str(path)).Load())
        for value in event.summary.value
        if value.tag == tag
    ]


def event_files(folder: Path) -> Iterator[Path]:
    """The event files of a run, oldest first."""
    yield from sorted(folder.glob("events.out.tfevents.*"))


def _keep(event: Event, step: int) -> bool:
    final = any(value.tag.startswith(("hp/", "_hparams_")) for value in event.summary.value)
    return event.step <= step and not final
