"""`sags latency`: the time from showing a code to seeing it in what a display would show.

    shown.py    the codes, and what shows them: images that are pushed, or a page that a camera films
    run.py      reads the codes in what a screen would show of the node
    ledger.py   when codes were shown and seen, and the latencies

Imports messaging and overlay.
"""
