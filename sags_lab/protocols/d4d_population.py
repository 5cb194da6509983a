"""D4D's public population: the scans that others measure on, chosen without a check against stereo.

By `d4d_meta` of github.com/TaiToTo/omnisurg-4d-scene-graph (2026): of 542 scans, two for each of 271 clips,
487 are kept. Left out are 45 beside which the tissue moves, 8 more than 10 s from the nearest frame, and 2
that are missing. The rule reads no figure. Its record of motion is not published, so the result is listed.
"""

LEFT_OUT: dict[str, dict[str, tuple[int, ...]]] = {  # numbers of clips, by their specimen and session
    "start": {
        "specimen_1/2025_03_06-16_56_00": (4, 5),
        "specimen_1/2025_03_06-17_04_37": (2,),
        "specimen_1/2025_03_06-17_38_21": (4,),
        "specimen_1/2025_03_06-17_39_51": (4, 5),
        "specimen_1/2025_03_06-17_51_03": (2, 3),
        "specimen_2/2025_04_10-16_14_33": (4,),
        "specimen_2/2025_04_10-16_19_14": (3,),
        "specimen_2/2025_04_10-16_36_48": (1,),
        "specimen_2/2025_04_10-16_40_32": (2,),
        "specimen_2/2025_04_10-16_43_56": (1,),
        "specimen_3/2025_05_08-14_27_51": (5,),
        "specimen_3/2025_05_08-14_39_50": (5,),
        "specimen_3/2025_05_08-14_56_07": (3, 4),
        "specimen_3/2025_05_08-14_59_26": (3,),
        "specimen_4/2025_06_05-14_52_19": (4, 5),
        "specimen_4/2025_06_05-15_01_38": (4, 5),
        "specimen_4/2025_06_05-15_16_21": (5,),
        "specimen_4/2025_06_05-15_17_56": (5,),
        "specimen_4/2025_06_05-15_25_49": (2, 3, 5),
        "specimen_4/2025_06_05-15_30_18": (2, 4),
        "specimen_4/2025_06_05-15_31_40": (5,),
        "specimen_4/2025_06_05-15_35_57": (5,),
        "specimen_4/2025_06_05-15_37_33": (5,),
        "specimen_4/2025_06_05-15_45_18": (1, 3),
        "specimen_4/2025_06_05-15_51_47": (3,),
        "specimen_5/2025_09_09-15_28_11": (1,),
        "specimen_5/2025_09_09-15_37_52": (2, 4),
        "specimen_5/2025_09_09-15_40_48": (2, 5),
        "specimen_5/2025_09_09-15_44_02": (4, 6),
        "specimen_5/2025_09_09-15_48_02": (3, 4, 5),
        "specimen_5/2025_09_09-15_51_52": (3,),
        "specimen_5/2025_09_09-15_55_15": (3, 4),
        "specimen_5/2025_09_09-15_58_44": (4, 5),
    },
    "end": {
        "specimen_1/2025_03_06-17_39_51": (5,),
        "specimen_3/2025_05_08-14_59_26": (2,),
        "specimen_4/2025_06_05-15_43_10": (2,),
        "specimen_4/2025_06_05-15_45_18": (3,),
        "specimen_4/2025_06_05-15_47_04": (2,),
    },
}


def in_population(clip: str, when: str) -> bool:
    """Tell whether the scan at the `start` or `end` of a clip, `specimen/session/Clip_K`, is kept."""
    session, _, name = clip.rpartition("/")
    return name not in {f"Clip_{number}" for number in LEFT_OUT[when].get(session, ())}
