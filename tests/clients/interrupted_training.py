"""The command line, whose group is told to end after a training's first iteration, as by a terminal."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from typing import Any

from straightpcf.clients.cli import main
from straightpcf.model.train import Stage, TrainStep, loop


def interrupted(stage: Stage, *, on_step: Any, **wanted: Any) -> Path:
    def step(done: TrainStep) -> None:
        on_step(done)
        if done.iteration == 1:
            os.killpg(0, signal.SIGTERM)

    return loop.train(stage, on_step=step, **wanted)


if __name__ == "__main__":
    import straightpcf.model.train

    os.setsid()  # a group of its own, which the signal goes to
    straightpcf.model.train.train = interrupted
    main()
