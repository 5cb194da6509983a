"""What a program that hands pictures or poses in gets back, once a second, as msgpack."""

from __future__ import annotations

import msgspec

from sags_node.messaging.wire import PROTOCOL


class Receipt(msgspec.Struct, frozen=True, kw_only=True):
    v: str = PROTOCOL
    taken: int  # messages since it connected
    refused: int
    overtaken: int  # that newer ones came before they were looked at
    problem: str | None = None  # what is wrong and how to fix it
