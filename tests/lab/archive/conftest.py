import os
from collections.abc import Iterator
from importlib.util import find_spec
from pathlib import Path
from typing import Any

import pytest
from places import HELPERS, ROOT
from tiny_archive import write_tiny_session

from sags_lab.archive.cluster import LOCAL, QUIET


@pytest.fixture(scope="session")
def tiny_session(tmp_path_factory: pytest.TempPathFactory) -> Path:
    folder = tmp_path_factory.mktemp("tiny") / "session"
    write_tiny_session(folder, seed=1)
    return folder


@pytest.fixture(scope="session")
def cluster() -> Iterator[Any]:
    """Two machines of one core each, both on this one."""
    if find_spec("ray") is None or find_spec("pyarrow") is None:
        pytest.skip("the extra archive is not installed")
    with pytest.MonkeyPatch.context() as patch:
        for name, value in (QUIET | LOCAL | {"RAY_AUTH_TOKEN": "t" * 32}).items():
            patch.setenv(name, value)  # before Ray is imported
        path = os.pathsep.join((str(HELPERS), str(ROOT), os.environ.get("PYTHONPATH", "")))
        patch.setenv("PYTHONPATH", path)  # of the workers
        from ray.cluster_utils import Cluster

        made = Cluster(initialize_head=True, head_node_args={"num_cpus": 1, "include_dashboard": False})
        made.add_node(num_cpus=1)
        try:
            yield made
        finally:
            made.shutdown()
