"""SB3 callbacks that visualise the learned table and save checkpoints."""

from __future__ import annotations

from .episode_video import EpisodeVideoCallback
from .hparams import HParamCallback
from .perception_stats import PerceptionStatsCallback
from .table_checkpoint import TableCheckpointCallback
from .value_map import ValueMapCallback

__all__ = [
    "EpisodeVideoCallback",
    "HParamCallback",
    "PerceptionStatsCallback",
    "TableCheckpointCallback",
    "ValueMapCallback",
]
