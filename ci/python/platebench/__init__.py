"""Runs the bench and reads its results as data frames."""

from ._campaign import Campaign, campaign
from ._program import PlatebenchError, program
from ._run import Run, run

__all__ = ["Campaign", "PlatebenchError", "Run", "campaign", "program", "run"]
