"""A node that is ready compiles nothing more: each kernel would stop it for a second or more, once on each
machine."""

import subprocess
import sys

import pytest

# In a process of its own: what another test has compiled is no merit of the warm-up.
PLAY = """
import sys
from itertools import islice

from numba.core.dispatcher import Dispatcher

from sags_node.mapping.budget import StepBudget
from sags_node.mapping.ladder import RUNGS
from sags_node.pipeline.pipeline import FrameRequest, Pipeline
from sags_node.pipeline.session import open_session
from sags_node.pipeline.warm_up import warm_up


def compiled():
    modules = [module for name, module in sys.modules.items() if name.startswith("sags_node.")]
    found = {each for module in modules for each in vars(module).values() if isinstance(each, Dispatcher)}
    return {(each.py_func.__module__, each.py_func.__name__, len(each.signatures)) for each in found}


small = ["source.width:=320", "source.height:=256", "source.pace:=step"]
session = open_session(None, [*small, *sys.argv[1:]])
with session.source as source:
    frames = list(islice(source, 12))
warm_up(session.config)
before = compiled()
for rung in (RUNGS[0], RUNGS[-1]):
    pipeline = Pipeline(session.config, session.rig, rate=30.0)
    request = FrameRequest(left=True, right=session.config.publish.right is not False, instruments=True)
    shown = [pipeline.process(frame, StepBudget(2, rung), request) for frame in frames]
    assert any(len(result.instruments or ()) for result in shown)
print(sorted(compiled() - before))
"""


@pytest.mark.parametrize(
    "settings",
    [
        (),
        # The left view alone draws what is hidden.
        ("publish.right:=false", "source.camera_motion:=sway", "vision.pose:=estimate"),
    ],
)
def test_a_warm_node_compiles_nothing_more(settings: tuple[str, ...]) -> None:
    command = [sys.executable, "-c", PLAY, *settings]
    done = subprocess.run(command, capture_output=True, text=True, check=False, timeout=600)
    assert (done.stdout, done.returncode) == ("[]\n", 0), done.stdout + done.stderr
