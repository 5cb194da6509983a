"""Every warning that there is. docs/warnings.md gives the cause and the fix of each."""

from collections.abc import Iterable, Mapping

from sags_node.types import Finding

STAGES: Mapping[str, str] = {  # code -> which stage of the work it is about
    "left_eye_black": "eyes",
    "right_eye_black": "eyes",
    "left_eye_white": "eyes",
    "right_eye_white": "eyes",
    "left_eye_plain": "eyes",
    "right_eye_plain": "eyes",
    "left_eye_fogged": "eyes",
    "right_eye_fogged": "eyes",
    "left_eye_frozen": "eyes",
    "right_eye_frozen": "eyes",
    "left_eye_drops": "eyes",
    "right_eye_drops": "eyes",
    "eyes_late": "eyes",
    "eyes_equal": "eyes",
    "eyes_exchanged": "eyes",
    "eyes_knocked": "eyes",
    "rows_differ": "calibration",
    "uncalibrated": "calibration",
    "calibration_changed": "calibration",
    "scale_declared": "depth",
    "tissue_too_near": "depth",
    "no_model": "depth",
    "picture_frozen": "picture",
    "picture_still": "picture",
    "picture_dark": "picture",
    "picture_bright": "picture",
    "picture_covered": "picture",
    "picture_smoke": "picture",
    "picture_blurred": "picture",
    "picture_compressed": "picture",
    "picture_unknown_scene": "picture",
    "camera_lost": "pose",
    "pose_missing": "pose",
    "pose_stopped": "pose",
    "pose_jumped": "pose",
    "pose_too_far": "pose",
    "tool_pose_missing": "pose",
    "mask_missing": "mask",
    "network_failed": "network",
    "gpu_memory": "device",
    "gpu_failed": "device",
    "red_blue_exchanged": "source",
    "no_frames": "source",
    "source_drops": "source",
    "sent_refused": "source",
    "two_senders": "source",
    "frames_missed": "capture",
    "mapping_hangs": "capture",
    "recording_ended": "recording",
    "recording_silent": "recording",
    "recording_loses": "recording",
    "recording_rejects": "recording",
    "recording_disk_low": "recording",
}

# Stages whose warnings do not make what is shown less certain.
OF_THE_FLOW = frozenset({"source", "capture", "recording"})
UNHEALTHY = frozenset({"recording_ended", "no_model"})  # codes that make the node unhealthy in any state

Findings = Mapping[str, tuple[Finding, ...]]  # by stage; a stage without any is left out
NOTHING: Findings = {}


def by_stage(findings: Iterable[Finding]) -> Findings:
    """Group findings by stage. A code that is not in `STAGES` raises KeyError: nobody could look it up."""
    sorted_out: dict[str, tuple[Finding, ...]] = {}
    for finding in findings:
        stage = STAGES[finding.code]
        sorted_out[stage] = (*sorted_out.get(stage, ()), finding)
    return sorted_out


def by_code(findings: Findings) -> dict[str, str]:
    """The findings by code: what is wrong and how to fix it."""
    return {finding.code: finding.text for found in findings.values() for finding in found}


def in_words(findings: Findings) -> dict[str, str]:
    """The findings by stage: what is wrong with it and how to fix it."""
    return {stage: "; ".join(finding.text for finding in found) for stage, found in findings.items()}
