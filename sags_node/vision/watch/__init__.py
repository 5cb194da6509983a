"""The watchers, which judge what of a frame may be trusted; `judgement` says how they are asked in turn.

`PoseWatch` there, `freeze_watch`, `pair_watch`, `scene_watch`, `lens_watch` and `color_watch` look at every
frame before it is used, `match_watch` at the matches of its eyes; the other files hold what they share.
"""
