"""A training process of torchrun; its second one may kill itself (SIGKILL) at step 20."""

import json
import os
import signal
import sys
from pathlib import Path

from services.world_model.paper_settings import TrainSettings
from services.world_model.training.distribution import joined_processes
from services.world_model.training.joint_trainer import TrainingProgress, train


def main(settings: Path, log: Path, killed_rank: int) -> None:
    """Train with these settings and write the loss log of the first process."""
    given = TrainSettings.model_validate_json(settings.read_text())
    with joined_processes(given.device, given.replicas) as processes:

        def on_progress(_: TrainingProgress) -> None:
            if processes.rank == killed_rank:
                os.kill(os.getpid(), signal.SIGKILL)

        report = train(given, on_progress, processes)
    if report is not None:
        rows = [(one.step, one.loss_video, one.loss_tactile) for one in report.log]
        log.write_text(json.dumps(rows))


if __name__ == "__main__":
    main(Path(sys.argv[1]), Path(sys.argv[2]), int(sys.argv[3]))
