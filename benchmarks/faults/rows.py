"""The rows of the table. A new one is a line here and a module with its trials."""

from __future__ import annotations

from benchmarks.faults import (
    checkpoints,
    covered,
    datasets,
    disk_full,
    fuzz,
    kill_checkpoint,
    kill_run,
    replay,
    resume_training,
    save_load,
)
from benchmarks.faults.measure import Row, Target

# fmt: off
_ROWS = (
    Row("kill-run", "`kill -9` of a benchmark run, and resume", "kills",
        "lost, repeated or different results, stray files, orphans", kill_run.run),
    Row("kill-checkpoint", "`kill -9` while a checkpoint is overwritten", "kills",
        "unreadable or torn files, stray files", kill_checkpoint.run),
    Row("disk-full", "Disk full at any byte", "writes",
        "damaged old files, stray files, unclear errors", disk_full.run),
    Row("mutated-checkpoints", "Damaged and forged checkpoints", "files",
        "executions, acceptances, other errors, hangs", checkpoints.run),
    Row("mutated-datasets", "Damaged and forged demonstrations", "sets",
        "executions, acceptances, other errors, hangs", datasets.run),
    Row("replay", "An episode replayed, alone and in batches", "episodes", "a different bit", replay.run),
    Row("save-load", "A stored agent in another process", "actions", "a different bit", save_load.run),
    Row("resume-training", "Training killed and resumed", "trainings", "a different weight", resume_training.run),
    Row("fuzz", "Arguments and settings that make no sense", "attempts",
        "tracebacks, wrong exit codes, more than a line, more than 1 s", fuzz.run),
    Row("coverage", "Code that the fast tests reach", "test files", "lines and branches", covered.run,
        Target(90.0, "%"), scaled=False),
)
# fmt: on
ROWS = {row.name: row for row in _ROWS}
