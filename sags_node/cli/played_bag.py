"""`sags bag record --session`: a recording played through a node of its own, all of it recorded."""

import tempfile
import threading
from collections.abc import Callable
from dataclasses import replace
from itertools import count
from pathlib import Path
from typing import Any

from sags_node.clients.recording.recorder import Recorder, RecordOptions
from sags_node.errors import SagsError
from sags_node.messaging.address import NodeAddress
from sags_node.node.node import Node
from sags_node.pipeline.session import Session
from sags_node.terminal.console import stop_signals
from sags_node.types import FrameResult

START_SECONDS = 30.0  # for the recorder to open its file
SUBSCRIBE_SECONDS = 1.0  # for its subscription to reach the node
LAST_SECONDS = 1.0  # for the last messages to reach the recorder
LOOK_PERIOD = 0.25  # s

Advance = Callable[[int, int | None, str], None]  # done, of, what


def record_session(session: Session, options: RecordOptions, advance: Advance) -> dict[str, Any]:
    """Play a recording and record what the node publishes, over sockets that no other node uses.

    Args:
        session: a recording with `source.pace` step: the node waits for nobody, and no frame is left out.
        options: where and how to record; `node` is ignored, as the node is made here.
        advance: called with what is going on.

    Returns:
        As `Recorder.run`, and the number of `frames`.

    Raises:
        SagsError: the node or the recorder failed, or a message was lost on the way.
    """
    opened = threading.Event()
    summary: dict[str, Any] = {}
    failed: list[BaseException] = []
    with tempfile.TemporaryDirectory(prefix="sags-record-") as private, stop_signals() as stop:
        own = {"data": (), "ipc": True, "control": None, "run_dir": Path(private)}
        config = session.config.model_copy(update={"publish": session.config.publish.model_copy(update=own)})
        sent = count(1)
        frames = session.source.frame_count

        def tell(result: FrameResult, latency_ms: float) -> None:
            advance(next(sent), frames, "recording")

        node = Node(config, session.rig, session.source, on_result=tell)
        recorder = Recorder(replace(options, node=NodeAddress(config.ns, run_dir=Path(private))))

        def record() -> None:
            try:
                summary.update(recorder.run(lambda said: opened.set()))
            except BaseException as error:  # raised below
                failed.append(error)
            opened.set()

        thread = threading.Thread(target=record, name="session-recorder", daemon=True)
        thread.start()
        try:
            if not opened.wait(START_SECONDS):
                raise SagsError(f"the recorder did not begin in {START_SECONDS:g} s; does the disk answer?")
            stop.wait(SUBSCRIBE_SECONDS)
            if not failed:
                node.start()
            while not (failed or stop.is_set() or node.wait(LOOK_PERIOD)):
                pass
            stop.wait(LAST_SECONDS)
        finally:
            node.stop()
            recorder.stop()
            thread.join()
    if failed:
        raise failed[0]
    if stop.is_set():
        raise KeyboardInterrupt
    if summary["lost"] or summary["dropped"]:
        raise SagsError(
            f"{summary['lost'] + summary['dropped']} messages of {session.name} were lost on the way to "
            f"{options.folder}: the disk is too slow; raise --max-cache"
        )
    return summary | {"frames": next(sent) - 1}
