"""Who judges what of a frame may be trusted: `judgement` says how they are asked, one after the other.

`PoseWatch` there, `freeze_watch`, `pair_watch`, `scene_watch`, `lens_watch` and `color_watch` look at every
frame before it is used, `match_watch` at the matches of its eyes; the other files are what they look by.
"""
