"""`sags latency`: from a code that is shown to that code in what a display would show.

    shown.py    the codes, and what shows them: pictures that are pushed, or a page that a camera films
    run.py      what a screen shows of the node, and when
    ledger.py   the figures of both

Imports messaging and overlay.
"""
