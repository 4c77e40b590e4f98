"""The paper's three training stages: `train("vm" | "cvm" | "dm", ...)`."""

from straightpcf.model.train.loop import Stage, TrainStep, train

__all__ = ["Stage", "TrainStep", "train"]
