"""Video files by their own stamps and counts: images tell their number, so what comes is known exactly."""

from fractions import Fraction
from pathlib import Path
from typing import Any

import av
import numpy as np
import pytest
from frames import played
from stamped_videos import number_in, numbered, write
from test_sources import Clock, taken

from sags_node.config import schema as cfg
from sags_node.errors import SagsError, UsageError
from sags_node.media.video import Video
from sags_node.sources.replay import Replay
from sags_node.sources.source import open_source
from sags_node.tools.calibration.guess import guess_rig
from sags_node.tools.importing.check import check_folder
from sags_node.types import U8, StereoFrame

COUNT = 50
RATE = 30
TS = {"format": "mpegts"}
MPEG2 = {"codec": "mpeg2video", "options": {"bf": "2"}}
OPEN_GOP = {"options": {"x264-params": "keyint=10:open-gop=1:bframes=3"}}
REFRESH = {"options": {"x264-params": "intra-refresh=1:keyint=10:bframes=0"}}
CONTAINERS = {
    "a.mp4": {}, "a.m4v": {"format": "mp4"}, "a.mov": {"codec": "prores_ks", "pixels": "yuv422p10le"},
    "a.3gp": {}, "a.mkv": {}, "a.webm": {"codec": "libvpx", "options": {"auto-alt-ref": "1"}}, "a.flv": {},
    "a.asf": {"codec": "msmpeg4"}, "a.wmv": {"codec": "wmv2", "format": "asf"},
    "b-frames.avi": {}, "mpeg4.avi": {"codec": "mpeg4", "options": {"bf": "2"}},
    "mjpeg.avi": {"codec": "mjpeg", "pixels": "yuvj420p"},
    "a.ts": TS, "A.MTS": TS, "a.m2ts": MPEG2 | TS, "a.vob": MPEG2 | {"format": "vob"},
    "a.mpg": MPEG2 | {"format": "mpeg"}, "a.mxf": MPEG2 | {"rate": 25},
    "rgb.mkv": {"codec": "ffv1", "pixels": "bgr0"}, "hevc.mp4": {"codec": "libx265"},
    "open.mp4": OPEN_GOP, "open.ts": OPEN_GOP | TS, "refresh.ts": REFRESH | TS,
    "pieces.mp4": {"muxer": {"movflags": "frag_keyframe+empty_moov"}}, "live.mkv": {"muxer": {"live": "1"}},
    "h.h264": {"format": "h264"},  # no stamps, no header
}  # fmt: skip


def pictures(numbers: range | list[int], eye: int = 0) -> list[U8]:
    return [numbered(number, eye=eye) for number in numbers]


@pytest.mark.parametrize("name", CONTAINERS)
def test_pictures_are_counted_and_found_in_every_container(tmp_path: Path, name: str) -> None:
    video = Video(write(tmp_path / name, pictures(range(COUNT)), **CONTAINERS[name]))
    assert video.count == COUNT and video.is_even and video.gaps == [] and not video.cut_off
    assert ["holds no times" in each for each in video.oddities] == [True] * (name == "h.h264")
    assert video.rate == (25 if name in ("a.mxf", "h.h264") else RATE)
    shown = [video.read(number) for number in range(COUNT)]
    assert [number_in(picture) for picture in shown if picture is not None] == list(range(COUNT))
    assert video.read(COUNT) is None
    for number in np.random.default_rng(0).permutation(COUNT)[:12].tolist():
        np.testing.assert_array_equal(video.read(number), shown[number])  # to the bit


def tracks(file: Path, pixels: str, shown: list[np.ndarray], raw: str = "rgb24") -> Path:
    """Lossless, with one image in each track."""
    with av.open(str(file), "w") as container:
        streams = [container.add_stream("ffv1", RATE) for _ in shown]
        for stream, picture in zip(streams, shown, strict=True):
            stream.height, stream.width, stream.pix_fmt = *picture.shape[:2], pixels
        for stream, picture in zip(streams, shown, strict=True):
            container.mux(stream.encode(av.VideoFrame.from_ndarray(picture, raw)))
        for stream in streams:
            container.mux(stream.encode())
    return file


def pair_of(left: Path, right: Path | None = None, **geometry: object) -> cfg.VideosSource:
    said = cfg.GeometryConfig.model_validate(geometry)
    return cfg.VideosSource(left=left, right=right, pace="step", geometry=said)


def numbers_of(frames: list[StereoFrame]) -> list[tuple[int, int]]:
    return [(number_in(frame.left), number_in(frame.right)) for frame in frames if frame.right is not None]


def same(numbers: list[int]) -> list[tuple[int, int]]:
    return [(number, number) for number in numbers]


def eye(
    file: Path,
    numbers: list[int],
    begin: float = 0.0,
    seed: int | None = None,
    rate: float = RATE,
    **how: Any,
) -> Path:
    """What one eye's recorder kept; every image has the stamp of its number, of a webcam (`seed`) 6 ms off at
    most."""
    off = np.zeros(COUNT) if seed is None else np.random.default_rng(seed).uniform(-0.006, 0.006, COUNT)
    seconds = [begin + number / rate + off[number] for number in numbers]
    return write(file, pictures(numbers, file.stem == "r"), seconds, **how)


ALL = list(range(COUNT))


def without(*lost: int) -> list[int]:
    return [number for number in ALL if number not in lost]


MOMENTS: dict[str, tuple[Any, Any, list[int]]] = {  # images and first stamp of each eye, and the pairs
    "lost in both": ([without(9, 10, 11)], [without(30, 31)], without(9, 10, 11, 30, 31)),
    "lost together": ([without(20)], [without(20)], without(20)),
    "own zeros, lost": ([without(20)], [ALL, 8.0], without(20)),  # two machines
    "own zeros": ([ALL, 3.0], [ALL], ALL),
    "late": ([ALL, 1.0], [ALL[21:], 1.0], ALL[21:]),  # begun later
    "jitter": ([without(4), 0.1, 0], [without(30), 0.1, 1], without(4, 30)),
    "skewed": ([without(5)], [ALL, 0.012], without(5)),  # two free clocks
}


@pytest.mark.parametrize("suffix", ["mp4", "mkv", "ts"])
@pytest.mark.parametrize("case", MOMENTS)
def test_pictures_of_one_moment_are_a_pair(tmp_path: Path, suffix: str, case: str) -> None:
    left, right, expected = MOMENTS[case]
    frames = played(pair_of(eye(tmp_path / f"l.{suffix}", *left), eye(tmp_path / f"r.{suffix}", *right)))
    assert numbers_of(frames) == same(expected)
    since = np.array([frame.t_capture_ns - frames[0].t_capture_ns for frame in frames]) * 1e-9
    true = (np.array(expected) - expected[0]) / RATE
    assert np.abs(since - true).max() < 0.0131  # jitter of two images, and whole milliseconds


def with_truth(folder: Path, lefts: list[int]) -> dict[str, object]:
    """Poses and tracks of each image of the left eye, which tell the image's number."""
    T_world_cam = np.tile(np.eye(4), (len(lefts), 1, 1))
    T_world_cam[:, 0, 3] = np.array(lefts) * 1e-3
    np.savez(folder / "poses.npz", T_world_cam=T_world_cam)
    points = np.zeros((len(lefts), 1, 3)) + np.reshape(lefts, (-1, 1, 1)) * 1e-3
    np.savez(folder / "tracks.npz", points=points, visible=np.ones((len(lefts), 1), np.bool_))
    reference = cfg.ReferenceConfig(tracks=folder / "tracks.npz")
    return {"poses": folder / "poses.npz", "reference": reference}


def check_truth(frames: list[StereoFrame], numbers: list[int]) -> None:
    assert [round(float(frame.T_world_cam[0, 3]) * 1e3) for frame in frames] == numbers  # type: ignore[index]
    assert [round(frame.reference.points[0, 0] * 1e3) for frame in frames] == numbers  # type: ignore[union-attr, index]


@pytest.mark.fault(
    "file: one eye's images were lost while recording, and poses are of all of the other eye's"
)
def test_poses_and_references_go_by_the_picture_of_the_left_eye(tmp_path: Path) -> None:
    left, right = eye(tmp_path / "l.mkv", without(9)), eye(tmp_path / "r.mkv", without(20, 21))
    config = pair_of(left, right).model_copy(update=with_truth(tmp_path, without(9)))
    check_truth(played(config), without(9, 20, 21))
    check_truth(played(config.model_copy(update={"start": 1.0})), [n for n in ALL if n >= 30])


@pytest.mark.parametrize(("first", "begin", "later"), [("left", 0, 1), ("right", 1, -1)])
@pytest.mark.parametrize("lost", [(), (16, 31), (17, 30, 31, 32)])
def test_a_lost_picture_of_eyes_in_turn_exchanges_no_eyes_and_poses_go_by_the_left_one(
    first: str, begin: int, later: int, lost: tuple[int, ...], tmp_path: Path
) -> None:
    """Its partner is left out, and there is as much time between the others as there was."""
    scope = eye(tmp_path / "scope.mp4", without(*lost))
    config = pair_of(scope, layout="frame_sequential", first=first)
    truth = with_truth(tmp_path, [number for number in range(begin, COUNT, 2) if number not in lost])
    frames = played(config.model_copy(update=truth))
    whole = [n for n in range(begin, COUNT, 2) if not {n, n + later} & {*lost}]
    check_truth(frames, whole)
    assert numbers_of(frames) == [(n, n + later) for n in whole]
    for frame in frames + played(config.model_copy(update={"stride": 2})):
        assert abs(frame.t_capture_right_ns - frame.t_capture_ns - later * 1e9 / RATE) < 1e5


def test_files_of_other_rates_are_refused_also_with_gaps(tmp_path: Path) -> None:
    right = eye(tmp_path / "r.mp4", ALL, rate=25)
    for shown, way in ((without(9), r"-i \S+/r.mp4 -r 30"), (ALL, r"-r 30 -i \S+/r.mp4")):
        left = eye(tmp_path / "l.mp4", shown)
        with pytest.raises(UsageError, match=rf"30 frames/s but .*25; .*\(ffmpeg {way} NEW\)"):
            open_source(pair_of(left, right))


def test_playing_begins_where_it_is_told_and_keeps_the_files_pace(tmp_path: Path) -> None:
    """A pause of 20 s: no image is early, and `source.start` is a time of the file."""
    seconds = [n / RATE + (20 if n >= 15 else 0) for n in ALL]
    left, right = (write(tmp_path / f"{s}.mp4", pictures(ALL, s == "r"), seconds) for s in "lr")
    config = pair_of(left, right)
    clock = Clock()
    began = clock.now
    frames, released, _ = taken(config.model_copy(update={"pace": "realtime"}), clock, lambda frame: 0.0)
    assert numbers_of(frames) == same(ALL)
    np.testing.assert_allclose(np.array(released) - began, seconds, atol=1e-4)
    for number in (0, 14, 15, 40):
        (frame,) = played(config.model_copy(update={"start": seconds[number], "frames": 1}))
        assert (frame.frame_id, *numbers_of([frame])) == (number, (number, number))


@pytest.mark.parametrize(("first", "begin"), [(12, -12 / RATE), (0, 0.7)], ids=["edit list", "late"])
@pytest.mark.parametrize("suffix", ["mp4", "mov"])
def test_what_a_header_says_is_not_believed(tmp_path: Path, first: int, begin: float, suffix: str) -> None:
    """Cut without encoding, an edit list hides the first twelve images."""
    file = eye(tmp_path / f"cut.{suffix}", ALL, begin, muxer={"avoid_negative_ts": "disabled"})
    video = Video(file)
    assert video.count == COUNT - first and video.is_even and not video.cut_off
    for number in (0, video.count - 1, 7):
        picture = video.read(number)
        assert picture is not None and number_in(picture) == number + first


X264 = "keyint=10:min-keyint=10:scenecut=0:bframes=0:cabac=0"  # with CABAC nearly all bytes mean something


@pytest.mark.fault("file: bytes in the middle of a video are damaged")
@pytest.mark.parametrize(
    ("name", "codec", "options", "lost"),
    [
        ("a.mkv", "libx264", {"x264-params": X264}, range(14, 20)),
        ("a.mp4", "libx264", {"x264-params": X264}, range(14, 20)),
        ("a.mpg", "mpeg2video", {"g": "10", "b": "2000000"}, range(14, 20)),
        ("a.mov", "prores_ks", {}, range(14, 15)),  # each image stands for itself
        # one sweep may have begun before the damage, so one more must have ended
        ("refresh.mkv", "libx264", {"x264-params": f"{X264}:intra-refresh=1"}, range(14, 30)),
    ],
)
def test_what_was_made_up_for_damaged_bytes_is_not_shown(
    tmp_path: Path, name: str, codec: str, options: dict[str, str], lost: range
) -> None:
    rng = np.random.default_rng(0)
    noise = rng.integers(0, 255, (96, 400, 3), np.uint8)
    shown = [np.ascontiguousarray(noise[:, number : number + 128]) for number in range(40)]
    pixels = "yuv422p10le" if codec == "prores_ks" else "yuv420p"
    file = write(tmp_path / name, shown, codec=codec, options=options, pixels=pixels)
    whole = [Video(file).read(number) for number in range(40)]
    with av.open(str(file)) as container:
        packet = [each for each in container.demux(video=0) if each.size][14]
    data, third = bytearray(file.read_bytes()), packet.size // 3
    begin = data.index(bytes(packet)[third : third + 64])
    data[begin : begin + third] = rng.bytes(third)
    file.write_bytes(data)
    video, left_out = Video(file), []
    for number in [*range(40), 39, 16, 5]:
        try:
            picture = video.read(number)
        except SagsError as error:
            left_out.append(number)
            assert "copy the file again" in str(error)
        else:
            np.testing.assert_array_equal(picture, whole[number], f"image {number}")  # to the bit
    assert left_out == [*lost, *({16} & {*lost})]


def joined(file: Path, *parts: list[U8]) -> Path:
    """Streams one behind the other."""
    each = [write(file.with_name(f"{n}.ts"), part).read_bytes() for n, part in enumerate(parts)]
    file.write_bytes(b"".join(each))
    return file


def test_stamps_that_begin_anew_are_passed_over(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    left, right = (joined(tmp_path / f"{side}.ts", *[pictures(ALL[:40])] * 2) for side in "lr")
    assert numbers_of(played(pair_of(left, right))) == same([*range(40), *range(40)])
    assert "begin anew near image" in caplog.text and f"-i {left} NEW" in caplog.text


@pytest.mark.parametrize(
    ("name", "how", "lost"),
    [
        ("a.mp4", {"muxer": {"movflags": "faststart"}}, 0.5),
        ("a.avi", {"codec": "mjpeg", "pixels": "yuvj420p"}, 0.5),
        ("a.mkv", {}, 0.5), ("a.mkv", {}, 0.02),
        ("a.webm", {"codec": "libvpx", "options": {"deadline": "realtime"}}, 0.02),
        ("a.ts", {}, 0.5), ("a.ts", {}, 0.02), ("a.mts", {"format": "mpegts"}, 0.02),
        ("a.m2ts", {"format": "mpegts", "muxer": {"mpegts_m2ts_mode": "1"}}, 0.3),
        ("a.vob", {"codec": "mpeg2video"}, 0.1), ("a.mpg", MPEG2 | {"format": "mpeg"}, 0.1),
        ("a.flv", {}, 0.02), ("a.flv", {"muxer": {"flvflags": "no_duration_filesize"}}, 0.05),
        ("a.mxf", MPEG2 | {"rate": 25}, 0.05), ("a.asf", {"codec": "msmpeg4"}, 0.25),
        ("a.wmv", CONTAINERS["a.wmv"], 0.25), ("live.mkv", {"muxer": {"live": "1"}}, 0.02),
        ("pieces.mp4", CONTAINERS["pieces.mp4"], 0.12),
    ],
)  # fmt: skip
def test_a_file_that_is_cut_off_is_told_from_a_whole_one(
    tmp_path: Path, name: str, how: dict[str, object], lost: float
) -> None:
    """Also from one that was never ended: it says no length, and may begin with what is no packet."""
    whole = write(tmp_path / name, pictures(range(120)), **how)  # type: ignore[arg-type]
    if name == "a.ts":
        whole.write_bytes(bytes(100) + whole.read_bytes())
    assert (Video(whole).count, Video(whole).cut_off) == (120, "")
    size = whole.stat().st_size
    cut = tmp_path / f"cut-{name}"
    cut.write_bytes(whole.read_bytes()[: size - int(lost * size) | 1])  # within a packet
    video = Video(cut)
    assert 0 < video.count < 120 and "cut off" in video.cut_off
    shown = [video.read(number) for number in range(video.count)]
    assert video.stamps is not None  # of images that refer to later ones the last may be missing
    rate = 25 if name == "a.mxf" else RATE
    numbers = np.rint((video.stamps - video.stamps[0]) * (rate * 1e-9)).tolist()
    assert [number_in(picture) for picture in shown if picture is not None] == numbers


def test_a_file_whose_pictures_change_size_says_where(tmp_path: Path) -> None:
    sizes = [(128, 96), (64, 48)]
    video = Video(joined(tmp_path / "both.ts", *([numbered(n, size)] * 20 for n, size in enumerate(sizes))))
    with pytest.raises(SagsError, match=r"is 64x48 px, the first one 128x96"):
        for number in range(video.count):
            video.read(number)


RED = (200, 40, 30)
BT601, BT709, BT2020, LIMITED, FULL = 5, 1, 9, 1, 2


@pytest.mark.parametrize(
    ("size", "matrix", "told", "how"),
    [
        ((640, 480), BT601, None, {}), ((1280, 720), BT709, None, {}), ((1350, 1080), BT601, None, {}),
        ((2560, 720), BT709, None, {}), ((1920, 2160), BT709, None, {}),  # two eyes
        ((640, 480), BT709, (BT709, LIMITED), {}), ((1280, 720), BT601, (6, LIMITED), {}),
        ((640, 480), BT709, (BT709, FULL), {}), ((640, 480), BT601, (3, LIMITED), {}),
        ((640, 480), BT2020, (BT2020, LIMITED), {"codec": "libx265", "pixels": "yuv420p10le"}),
        ((1280, 720), BT601, None, {"codec": "mjpeg", "pixels": "yuvj420p"}),  # as JPEG says
        ((1280, 720), None, None, {"codec": "ffv1", "pixels": "bgr0"}),
    ],
)  # fmt: skip
def test_colours_are_those_that_were_encoded(
    tmp_path: Path, size: tuple[int, int], matrix: int | None, told: tuple[int, int] | None, how: Any
) -> None:
    """Within 3 of 255: YUV of eight bits, and its compression."""
    red = np.full((size[1], size[0], 3), RED, np.uint8)
    picture = Video(write(tmp_path / "a.mkv", [red] * 2, matrix=matrix, told=told, **how)).read(1)
    assert np.abs(picture.reshape(-1, 3).mean(0) - RED).max() < 3


@pytest.mark.parametrize(
    ("size", "layout", "told", "aspect"),
    [
        ((320, 180), "side_by_side", None, 2.0),  # eyes of 160x180: half as wide as they were
        ((320, 180), "side_by_side", Fraction(2), 2.0), ((640, 180), "side_by_side", None, 1.0),
        ((320, 180), "over_under", None, 0.5), ((320, 256), "over_under", None, 0.5),
        ((180, 320), "over_under", None, 1.0),
        ((320, 256), "row_interleaved", None, 0.5), ((320, 256), "side_by_side", Fraction(16, 15), 16 / 15),
    ],
)  # fmt: skip
def test_a_guessed_camera_has_the_pixels_of_the_file(
    tmp_path: Path, size: tuple[int, int], layout: str, told: Fraction | None, aspect: float
) -> None:
    noise = np.random.default_rng(0).integers(0, 255, (size[1], size[0], 3), np.uint8)
    file = write(tmp_path / "a.mp4", [noise] * 3, aspect=told)
    K = guess_rig(pair_of(file, layout=layout)).left.K
    assert K[1, 1] / K[0, 0] == pytest.approx(aspect, rel=1e-6)


@pytest.mark.parametrize("mirrored", [False, True])
@pytest.mark.parametrize("degrees", [0, 90, 180, 270])
def test_a_picture_that_the_file_turns_comes_upright(tmp_path: Path, degrees: int, mirrored: bool) -> None:
    upright = numbered(11)
    upright[:20, :30] = 0
    stored = np.ascontiguousarray(np.rot90(upright[:, :: -1 if mirrored else 1], -degrees // 90))
    video = Video(write(tmp_path / "a.mp4", [stored], turned=(degrees, mirrored)))
    picture = video.read(0)
    assert picture is not None and video.size == (upright.shape[1], upright.shape[0])
    assert np.abs(picture.astype(int) - upright).mean() < 3


def test_even_files_whose_rates_differ_a_little_are_paired_by_time(tmp_path: Path) -> None:
    """As many images at both rates are another matter: one rate is wrong, or an eye runs on its own."""
    rate = Fraction(249, 10)
    left = write(tmp_path / "l.mkv", pictures(range(200)), rate=25)
    for count, how in ((199, "time"), (200, "number")):
        shown = [round(n * 25 / float(rate)) % 256 if how == "time" else n for n in range(count)]
        right = write(tmp_path / "r.mkv", pictures(shown), rate=rate)
        config = pair_of(left, right)
        frames = numbers_of(played(config))
        assert len(frames) > 190 and all(abs(of_left - of_right) <= 1 for of_left, of_right in frames)
        (said,) = Replay(config).pairs.oddities
        assert f"paired by {how}" in said and "25 frames/s but" in said


def test_eyes_that_are_interlaced_or_have_other_pixels_are_told(tmp_path: Path) -> None:
    """Of interlaced ones unless their fields are taken."""
    fields = {"x264-params": "interlaced=1:tff=1"}
    left, right = (
        write(tmp_path / f"{side}.mp4", pictures(range(9)), aspect=aspect, options=fields)
        for side, aspect in (("l", Fraction(4, 3)), ("r", None))
    )
    for said in ({}, {"deinterlace": "top"}):
        *torn, pixels = Replay(pair_of(left, right, **said)).pairs.oddities
        assert len(torn) == (0 if said else 2) and "1.33 times as wide as high" in pixels
        assert all("interlaced" in each and "deinterlace:=top" in each for each in torn)


@pytest.mark.parametrize("pixels", ["gray16le", "rgb48le", "gbrp16le"])
@pytest.mark.parametrize(("bits", "is_told"), [(12, True), (16, False)])
def test_bits_that_a_deep_video_does_not_use_are_told(
    tmp_path: Path, bits: int, is_told: bool, pixels: str
) -> None:
    samples = np.linspace(0, 2**bits - 1, 128 * 96).astype(np.uint16).reshape(96, 128)
    shown = samples if pixels == "gray16le" else np.repeat(samples[..., None], 3, axis=2)
    video = Video(tracks(tmp_path / "a.mkv", pixels, [shown], pixels))
    picture = video.read(0)
    assert picture is not None and is_told == ("uses 12: it may be played too dark" in str(video.oddities))
    assert np.abs(picture[..., 1] - samples / 257).max() < 2


def test_what_a_picture_a_second_shows_is_no_file_that_is_cut_off(tmp_path: Path) -> None:
    """Images that are decoded before others are shown: the last is decoded two seconds before its turn."""
    file = write(tmp_path / "a.mp4", pictures(range(20)), [10.0 * n for n in range(20)], ticks=1000)
    assert (Video(file).count, Video(file).cut_off, Video(file).rate) == (20, "", 0.1)


@pytest.mark.parametrize(("transfer", "name"), [("smpte2084", "PQ"), ("arib-std-b67", "HLG"), ("bt709", "")])
def test_tones_of_hdr_are_told(tmp_path: Path, transfer: str, name: str) -> None:
    options = {"x264-params": f"transfer={transfer}"}
    said = Video(write(tmp_path / "a.mp4", pictures(range(3)), options=options)).oddities
    assert [f"tones of HDR ({name})" in each for each in said] == [True] * bool(name)


def test_a_second_track_is_told_with_how_to_take_eyes_apart(tmp_path: Path) -> None:
    scope = tracks(tmp_path / "scope.mkv", "bgr0", [numbered(1, eye=eye) for eye in (0, 1)])
    (error,) = [each for each in check_folder(tmp_path) if each.level == "error"][:1]
    assert "2 video tracks" in error.fix
    assert f"-i {scope} -map 0:v:0 -c copy left.mkv -map 0:v:1 -c copy right.mkv" in error.fix


def test_a_name_that_looks_like_an_address_or_a_pattern_is_a_name(tmp_path: Path) -> None:
    for name in ("http:a.mp4", "a%03d.mp4", "pipe:1.mkv", "a b#é.mp4"):
        assert Video(write(tmp_path / "x.mp4", pictures([7])).rename(tmp_path / name)).count == 1
    (tmp_path / "list.mp4").write_text(f"#EXTM3U\n#EXTINF:1,\n{tmp_path / 'http:a.mp4'}\n#EXT-X-ENDLIST\n")
    with pytest.raises(UsageError, match="cannot be read as a video"):
        Video(tmp_path / "list.mp4")
