"""A Ray cluster on the loopback address, to which nodes can be added and from which they can be removed."""

from __future__ import annotations

import shutil
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest
import ray
from ray._private import ray_constants
from ray.cluster_utils import Cluster

TESTS = str(Path(__file__).parent)
NODE: dict[str, Any] = {"node_ip_address": "127.0.0.1", "object_store_memory": 80 * 2**20}


@contextmanager
def loopback_cluster(**node: Any) -> Iterator[Cluster]:
    """A cluster of a head without CPUs and one node; this process is connected to it.

    :param node: what the node has, as Ray calls it
    """
    folder = tempfile.mkdtemp(prefix="ray", dir="/tmp")  # socket paths must be short
    head = {**NODE, "num_cpus": 0, "include_dashboard": False}
    with pytest.MonkeyPatch.context() as patch:
        # Ray writes all its files there, including the address of the cluster.
        patch.setenv("RAY_TMPDIR", folder)
        patch.setenv("RAY_USAGE_STATS_ENABLED", "0")
        # Single-machine clusters use the loopback address.
        patch.setattr(ray_constants, "ENABLE_RAY_CLUSTER", False)
        made = Cluster(initialize_head=True, head_node_args=head)
        made.add_node(**NODE, **node)
        ray.init(
            made.address, runtime_env={"env_vars": {"PYTHONPATH": TESTS}}, log_to_driver=False, logging_level="error"
        )
        try:
            yield made
        finally:
            ray.shutdown()
            made.shutdown()
            shutil.rmtree(folder, ignore_errors=True)
