"""Every form of calibration file is written here by others' means, and read back; then what cannot be."""

import gzip
import re
import tarfile
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from typing import Any

import cv2
import numpy as np
import pytest
import yaml
from command_line import ran
from packed import pack
from places import ROOT

from sags_node.config.units import UNITS
from sags_node.errors import UsageError
from sags_node.geometry import scale_intrinsics
from sags_node.rig import check_rig, load_rig, read_rig, rectify_eyes, resized_rig, save_rig
from sags_node.types import F64, StereoRig

SIZE = 640, 480
K = (
    np.array([[552.3, 0, 318.2], [0, 551.1, 243.6], [0, 0, 1]]),
    np.array([[549.8, 0, 323.9], [0, 548.9, 239.4], [0, 0, 1]]),
)
PLUMB_BOB = np.array([-0.18, 0.09, 4e-4, -7e-4, 0.01]), np.array([-0.17, 0.08, -3e-4, 5e-4, 0.02])
R = cv2.Rodrigues(np.array([0.004, -0.011, 0.006]))[0]
T = np.array([-5.2e-3, 4e-5, 6e-5])  # m
MATRICES = {"M1": K[0], "D1": PLUMB_BOB[0], "M2": K[1], "D2": PLUMB_BOB[1], "R": R, "T": T}
RATIONAL = (
    np.array([0.3, 0.1, 1e-3, -5e-4, 0.02, 0.5, 0.2, 0.01]),
    np.array([0.2, 0.1, -1e-3, 4e-4, 0.01, 0.4, 0.2, 0.02]),
)


def make_rig(distortion: tuple[F64, F64] = PLUMB_BOB) -> StereoRig:
    """A rig with lens distortion and eyes turned against each other."""
    return rectify_eyes("rig", SIZE, K, distortion, R, T)


def assert_same(read: StereoRig, rig: StereoRig, tolerance: float = 1e-9) -> None:
    for side in ("left", "right"):
        a, b = getattr(read, side), getattr(rig, side)
        assert (a.width, a.height) == (b.width, b.height)
        for field in ("K", "distortion", "R", "P"):
            np.testing.assert_allclose(getattr(a, field), getattr(b, field), atol=tolerance, err_msg=field)


def write(file: Path, matrices: dict[str, object]) -> Path:
    storage = cv2.FileStorage(str(file), cv2.FILE_STORAGE_WRITE)
    for key, value in matrices.items():
        storage.write(key, value)
    storage.release()
    return file


def write_pair(folder: Path, suffix: str, distortion: tuple[F64, F64], T_file: F64) -> Path:
    """As OpenCV's sample stereo_calib does."""
    folder.mkdir()
    names = "M1", "D1", "M2", "D2"
    values = K[0], distortion[0][None], K[1], distortion[1][None]
    write(folder / f"intrinsics{suffix}", dict(zip(names, values, strict=True)))
    write(folder / f"extrinsics{suffix}", {"R": R, "T": T_file[:, None]})
    return folder


def refusal(path: Path, size: tuple[int, int] | None = None) -> str:
    with pytest.raises(UsageError) as caught:
        read_rig(path, size)
    return str(caught.value)


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    save_rig(make_rig(), tmp_path / "rig")
    return tmp_path / "rig"


def edit(folder: Path, side: str, change: dict[str, Any]) -> None:
    """Change a saved file; a value of None removes the key."""
    file = folder / f"{side}.yaml"
    tree = yaml.safe_load(file.read_text()) | change
    file.write_text(yaml.safe_dump({key: value for key, value in tree.items() if value is not None}))


def converted(folder: Path, out: Path, *more: str, size: str | None = "640x480") -> tuple[int, str]:
    """The exit code of `sags calib convert`, and what it says."""
    asked = () if size is None else ("--size", size)
    code, _, said = ran("calib", "convert", folder, "-o", out, *asked, *more)
    return code, said


# ---- ROS -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL], ids=["plumb_bob", "rational_polynomial"])
def test_ros_files_and_one_that_stands_for_both(distortion: tuple[F64, F64], tmp_path: Path) -> None:
    save_rig(make_rig(distortion), tmp_path / "rig")
    for path in (tmp_path / "rig", tmp_path / "rig/right.yaml"):
        rig = load_rig(path)
        assert_same(rig, make_rig(distortion), 0)
        assert rig.name == "rig" and rig.baseline == pytest.approx(np.linalg.norm(T))
        np.testing.assert_allclose(rig.T_right_left, np.block([[R, T[:, None]], [0, 0, 0, 1]]), atol=1e-9)


@pytest.mark.parametrize("name", ["d4d", "hamlyn_heart", "v4l2_example"])
def test_shipped_calibrations_have_no_finding(name: str) -> None:
    assert {finding.level for finding in check_rig(load_rig(ROOT / "calib" / name))} == {"ok"}


def test_coefficients_as_ros_writes_them(folder: Path) -> None:
    """Four and no model; 1e-05, which YAML 1.1 reads as a string; all numbers in one string."""
    edit(folder, "right", {"distortion_model": "radtan"})
    four = {"rows": 1, "cols": 4, "data": [-0.1, 0.02, 0.0, 0.001]}
    edit(folder, "left", {"distortion_model": None, "distortion_coefficients": four, "binning_x": 0})
    np.testing.assert_array_equal(load_rig(folder).left.distortion, [-0.1, 0.02, 0.0, 0.001, 0.0])
    (folder / "left.yaml").write_text((folder / "left.yaml").read_text().replace("- -0.1\n", "- 1e-05\n"))
    assert load_rig(folder).left.distortion[0] == 1e-5
    edit(folder, "left", {"distortion_coefficients": {"data": ["-0.1 0.02 0.0 1e-03"]}})
    np.testing.assert_array_equal(load_rig(folder).left.distortion, [-0.1, 0.02, 0.0, 0.001, 0.0])


def echoed(names: str, binning: int) -> dict[str, str]:
    """What `topic echo` prints of the camera_info of both eyes; ROS 1 has capitals."""
    rig = make_rig()
    printed = {}
    for side, eye in (("left", rig.left), ("right", rig.right)):
        matrices = (each.ravel().tolist() for each in (eye.distortion, eye.K, eye.R, eye.P))
        message: dict[str, Any] = dict(zip(names, matrices, strict=True))
        message |= {"header": {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": side}}
        message |= {"height": eye.height, "width": eye.width, "distortion_model": "plumb_bob"}
        message |= {"binning_x": binning, "binning_y": binning}
        printed[f"{side}.yaml"] = yaml.safe_dump(message) + "---\n"
    return printed


@pytest.mark.parametrize("names", ["dkrp", "DKRP"])
@pytest.mark.parametrize(("copies", "binning"), [(1, 0), (2, 0), (1, 2)])
def test_what_topic_echo_prints(tmp_path: Path, names: str, copies: int, binning: int) -> None:
    for name, text in echoed(names, binning).items():
        (tmp_path / name).write_text(text * copies)
    assert_same(load_rig(tmp_path), resized_rig(make_rig(), 0.5) if binning else make_rig())


@pytest.fixture
def ros_files(folder: Path) -> dict[str, bytes]:
    return {name: (folder / name).read_bytes() for name in ("left.yaml", "right.yaml")}


def test_archive_of_ros_camera_calibration(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    """The file, and the folder that holds it; nothing is written outside of it."""
    pictures = {f"left-{index:04d}.png": bytes(5000) for index in range(3)}
    inside = tmp_path / "deep/er"
    inside.mkdir(parents=True)
    outward = {f"../../{name}": text for name, text in ros_files.items()}
    file = pack(inside / "calibrationdata.tar.gz", pictures | outward | {"ost.txt": b"# oST"})
    before = sorted(tmp_path.rglob("*"))
    for path in (file, inside):
        assert_same(load_rig(path), make_rig(), 0)
    assert load_rig(file).name == "calibrationdata" and sorted(tmp_path.rglob("*")) == before


def test_archives_that_are_refused(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    one_eye = pack(tmp_path / "one.tar.gz", {"left.yaml": ros_files["left.yaml"]})
    large = pack(tmp_path / "large.tar.gz", {"left.yaml": b" " * (2**20 + 1)})
    (tmp_path / "cut.tar.gz").write_bytes(pack(tmp_path / "whole.tar.gz", ros_files).read_bytes()[:200])
    assert "holds no right.yaml" in refusal(one_eye) and "larger than" in refusal(large)
    for name in ("cut.tar.gz", "gone.tar.gz"):
        assert f"{name} is not a readable tar.gz" in refusal(tmp_path / name)


@pytest.mark.fault("memory: an archive claims to be huge")
@pytest.mark.parametrize("kind", [tarfile.XHDTYPE, tarfile.GNUTYPE_LONGNAME, tarfile.REGTYPE])
def test_an_archive_that_claims_to_be_huge_takes_no_memory(tmp_path: Path, kind: bytes) -> None:
    info = tarfile.TarInfo("left-0000.png")
    info.type, info.size = kind, 2**40
    with gzip.open(tmp_path / "forged.tar.gz", "wb") as file:
        file.write(info.tobuf(tarfile.GNU_FORMAT) + bytes(4096))
    assert "not a readable tar.gz" in refusal(tmp_path / "forged.tar.gz")


# ---- OpenCV ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("distortion", [PLUMB_BOB, RATIONAL])
@pytest.mark.parametrize("suffix", [".yml", ".xml"])
def test_the_pair_of_opencv_files(tmp_path: Path, suffix: str, distortion: tuple[F64, F64]) -> None:
    folder = write_pair(tmp_path / "rig", suffix, distortion, T * 1000)
    assert_same(read_rig(folder, SIZE, 1e-3), make_rig(distortion))
    write(folder / f"extrinsics{suffix}", {"R": R, "T": T * 1000})  # of one dimension, since OpenCV 5
    assert_same(read_rig(folder / f"extrinsics{suffix}", SIZE, 1e-3), make_rig(distortion))


@pytest.mark.parametrize("said", [
    "fisheye_model: 1", "use_fisheye: yes", "model: fisheye", "distortion_model: equidistant",
    "camera_model: KannalaBrandt8", "cameraModel: omnidirectional", "xi: 1.2",
])  # fmt: skip
def test_other_models_of_opencv_files_are_refused(tmp_path: Path, said: str) -> None:
    """By what the file says of itself; what says that it is of no other model is read."""
    folder = write_pair(tmp_path / "rig", ".yml", PLUMB_BOB, T)
    intrinsics = folder / "intrinsics.yml"
    text = intrinsics.read_text()
    intrinsics.write_text(f"{text}{said}\n")
    assert f"{said} is not supported" in refusal(folder, SIZE)
    intrinsics.write_text(f"{text}fisheye_model: 0\nxi: 0.\nmodel: plumb_bob\ncamera_model: SN-4711\n")
    assert_same(read_rig(folder, SIZE), make_rig())


@pytest.mark.parametrize(("focal", "asked"), [(352.0, True), (552.0, False)])
def test_four_coefficients_of_a_wide_view_are_asked_about(focal: float, asked: bool) -> None:
    """640x480 px: 800 px from corner to corner are 97 degrees of 352 px, and 72 of 552 px."""
    K_wide = np.array([[focal, 0, 320], [0, focal, 240], [0, 0, 1]])
    for distortion, fits in ((np.array([0.06, -0.02, 0.01, -0.003, 0]), asked), (PLUMB_BOB[0], False)):
        rig = rectify_eyes("rig", SIZE, (K_wide, K_wide), (distortion, distortion), R, T)
        said = [finding for finding in check_rig(rig) if "fisheye" in finding.what]
        assert bool(said) is fits


@pytest.mark.parametrize(
    ("unit", "said"), [("cm", "mm"), ("cm", "um"), ("mm", "m"), ("inch", "mm"), ("um", "mm")]
)
def test_a_wrong_unit_is_refused_and_the_right_one_named(unit: str, said: str, tmp_path: Path) -> None:
    folder = write_pair(tmp_path / "rig", ".yml", PLUMB_BOB, T / UNITS[unit])
    code, text = converted(folder, tmp_path / "out", "--unit", said)
    assert code == 2 and f"--unit {said} makes the baseline" in text and not (tmp_path / "out").exists()
    assert re.findall(r"say --unit (\w+) \(5.2 mm\)", text) == [unit]
    code, text, _ = ran("calib", "check", folder, "--size", "640x480", "--unit", said, "--json")
    assert code == 1 and f"say --unit {unit} (5.2 mm)" in text
    assert converted(folder, tmp_path / "out", "--unit", unit)[0] == 0
    assert_same(load_rig(tmp_path / "out"), make_rig())


@pytest.mark.parametrize(("said", "baseline"), [("cm", 0.06), ("inch", 0.09), ("m", 0.15), ("mm", 0.02)])
@pytest.mark.parametrize("form", ["OpenCV", "ROS"])
def test_a_rig_that_is_no_endoscope_is_taken(form: str, said: str, baseline: float, tmp_path: Path) -> None:
    """As the refusal says: it reads as an endoscope in another unit, which does not make it one. 20 mm are of
    none in any unit."""
    T_rig = T * (baseline / np.linalg.norm(T))

    def in_unit(metres: float, unit: str) -> tuple[int, str]:
        folder = tmp_path / f"{unit}-{metres}"
        if form == "OpenCV":
            write_pair(folder, ".yml", PLUMB_BOB, T_rig / metres)
        else:
            save_rig(rectify_eyes("rig", SIZE, K, PLUMB_BOB, R, T_rig / metres), folder)
        size = "640x480" if form == "OpenCV" else None
        return converted(folder, tmp_path / "out", "--unit", unit, size=size)

    code, text = in_unit(UNITS[said], said)
    if said in ("cm", "inch"):
        assert code == 2 and f"--unit {said} makes the baseline {1e3 * baseline:g} mm" in text
        (factor,) = re.findall(r"divide the baseline in the files by (\S+) .*, and say --unit m$", text, re.M)
        code, text = in_unit(UNITS[said] * float(factor), "m")
    assert code == 0 and f"baseline {1e3 * baseline:g} mm" in text, text
    assert load_rig(tmp_path / "out").baseline == pytest.approx(baseline, rel=1e-5)


@pytest.mark.parametrize(
    "names",
    ["M1 D1 M2 D2", "K1 D1 K2 D2", "KL DL KR DR", "cameraMatrix1 distCoeffs1 cameraMatrix2 distCoeffs2"],
)
@pytest.mark.parametrize("size", ["image_width image_height", "width height", "imageSize", "image_size"])
def test_one_opencv_file(tmp_path: Path, names: str, size: str) -> None:
    values = K[0], PLUMB_BOB[0], K[1], PLUMB_BOB[1]
    matrices = dict(zip(names.split(), values, strict=True)) | {"R": R, "T": T}
    sides = SIZE if " " in size else (SIZE,)
    read = read_rig(write(tmp_path / "scope_a.yaml", matrices | dict(zip(size.split(), sides, strict=True))))
    assert read.name == "scope_a"
    assert_same(read, make_rig())


def test_the_size_as_a_sequence(tmp_path: Path) -> None:
    """As C++ programs write a cv::Size."""
    file = write(tmp_path / "rig.yml", MATRICES)
    text = file.read_text()
    file.write_text(text.replace("---", "---\nimageSize: [ 640, 480 ]", 1))
    assert_same(read_rig(file), make_rig())
    for wrong in ("[ 640, 0 ]", "[ 640, 1000000000 ]", "[ .Nan, 480 ]"):
        file.write_text(text.replace("---", f"---\nimageSize: {wrong}", 1))
        assert "is not possible" in refusal(file)


def test_a_rectification_in_the_files_is_kept(tmp_path: Path) -> None:
    # Another one than is made here.
    whole = cv2.stereoRectify(K[0], PLUMB_BOB[0], K[1], PLUMB_BOB[1], SIZE, R, T[:, None] * 1000, alpha=1)
    names = "R1", "R2", "P1", "P2"
    matrices = MATRICES | {"T": T * 1000} | dict(zip(names, whole[:4], strict=True))
    file = write(tmp_path / "rig.yml", matrices)
    rig = read_rig(file, SIZE, 1e-3)
    np.testing.assert_allclose(rig.right.R, whole[1])
    np.testing.assert_allclose(rig.right.P[:, :3], whole[3][:, :3])
    assert rig.baseline == pytest.approx(np.linalg.norm(T))
    assert abs(rig.left.P[0, 0] - make_rig().left.P[0, 0]) > 1


def test_zeros_after_the_coefficients_do_not_count(tmp_path: Path) -> None:
    """OpenCV writes 14 where fewer were fitted."""
    padded = tuple(np.pad(part, (0, 14 - len(part))) for part in RATIONAL)
    folder = write_pair(tmp_path / "rig", ".yml", (padded[0], padded[1]), T)
    assert_same(read_rig(folder, SIZE), make_rig(RATIONAL))
    padded[0][9] = 0.01
    folder = write_pair(tmp_path / "prism", ".yml", (padded[0], padded[1]), T)
    assert "10 distortion coefficients" in refusal(folder, SIZE)


@pytest.mark.parametrize(
    ("change", "said"),
    [
        ({"M2": None}, "looked for a matrix named M2, K2"),
        ({"R": np.eye(2)}, "R is not a matrix of 9 numbers"),
        ({"R": np.array([0.1, 0, 0])}, "of a rotation vector save cv2.Rodrigues(R)[0]"),
        ({"R": np.diag([1.0, 1, -1])}, "is not a rotation"),
        ({"T": np.zeros(3)}, "no baseline"),
        ({"T": np.array([np.nan, 0, 0])}, "NaN"),
        ({"T": "five"}, "T is not a matrix of 3 numbers"),
    ],
)
def test_wrong_matrices_are_named(tmp_path: Path, change: dict[str, object], said: str) -> None:
    kept = {key: value for key, value in (MATRICES | change).items() if value is not None}
    message = refusal(write(tmp_path / "rig.yml", kept), SIZE)
    assert "rig" in message and said in message


@pytest.mark.parametrize("shape", [(100_000, 1_000_000), (3, 3)])
def test_opencv_matrices_that_are_cut_off(tmp_path: Path, shape: tuple[int, int]) -> None:
    file, (rows, cols) = tmp_path / "rig.yml", shape
    held = f"   rows: {rows}\n   cols: {cols}\n   dt: d\n   data: [ 1., 2. ]\n"
    file.write_text(f"%YAML:1.0\n---\nM1: !!opencv-matrix\n{held}")
    assert str(file) in refusal(file, SIZE)


# ---- text ------------------------------------------------------------------------------------------------


def write_text(folder: Path, prefix: str = "calib.", plural: str = "s", l2r: str = "l2r.txt") -> Path:
    folder.mkdir()
    for side, matrix, distortion in zip(("left", "right"), K, PLUMB_BOB, strict=True):
        np.savetxt(folder / f"{prefix}{side}.intrinsic{plural}.txt", matrix)
        np.savetxt(folder / f"{prefix}{side}.distortion.txt", distortion[None])
    transform = np.eye(4)
    transform[:3, :3], transform[:3, 3] = R, T * 1000
    np.savetxt(folder / f"{prefix}{l2r}", transform)
    return folder


@pytest.mark.parametrize(
    ("prefix", "plural", "l2r"), [("calib.", "s", "l2r.txt"), ("calib.", "", "l2r.4x4"), ("", "s", "l2r.txt")]
)
def test_text_matrices_are_millimetres(tmp_path: Path, prefix: str, plural: str, l2r: str) -> None:
    folder = write_text(tmp_path / "rig", prefix, plural, l2r)
    assert_same(read_rig(folder, SIZE), make_rig())


@pytest.mark.parametrize("unit", ["m", "cm", "um", "inch"])
def test_text_matrices_in_another_unit_say_which_one_and_how(tmp_path: Path, unit: str) -> None:
    folder = write_text(tmp_path / "rig")
    transform = np.loadtxt(folder / "calib.l2r.txt")
    transform[:3, 3] *= 1e-3 / UNITS[unit]
    np.savetxt(folder / "calib.l2r.txt", transform)
    (odd,) = [each for each in check_rig(read_rig(folder, SIZE)) if each.level != "ok"]
    assert re.findall(r"--unit (\w+)", odd.fix) == [unit] and "millimetres are usual" in odd.fix
    assert (odd.level == "error") == (unit in ("m", "um"))  # 0.5 and 0.2 mm may be
    right = check_rig(read_rig(folder, SIZE, UNITS[unit]), UNITS[unit])
    assert {each.level for each in right} == {"ok"}


def test_text_matrices_that_are_refused(tmp_path: Path) -> None:
    folder = write_text(tmp_path / "rig")
    for unsized in (folder, write_pair(tmp_path / "pair", ".yml", PLUMB_BOB, T)):
        assert "does not say the size of the images: give --size WxH" in refusal(unsized)
    file = folder / "calib.left.distortion.txt"
    for text, said in (("a b c d e", "holds something else than"), ("0 0 0", "holds 3 numbers")):
        file.write_text(text)
        assert said in refusal(folder, SIZE)
    file.unlink()
    assert "*left.distortion*.txt is needed, found: none" in refusal(folder, SIZE)
    np.savetxt(folder / "old.left.intrinsics.txt", K[0])
    assert "calib.left.intrinsics.txt, old.left.intrinsics.txt" in refusal(folder, SIZE)


# ---- other formats ---------------------------------------------------------------------------------------


def test_the_page_converts_kalibrs_camchain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    chain = {}
    for number, (K_eye, lens) in enumerate(zip(K, PLUMB_BOB, strict=True)):
        numbers = {"intrinsics": K_eye[[0, 1, 0, 1], [0, 1, 2, 2]].tolist(), "resolution": [*SIZE]}
        chain[f"cam{number}"] = numbers | {"distortion_coeffs": lens[:4].tolist()}
    chain["cam1"]["T_cn_cnm1"] = np.block([[R, T[:, None]], [np.zeros(3), np.ones(1)]]).tolist()
    (tmp_path / "camchain.yaml").write_text(yaml.safe_dump(chain))
    page = (ROOT / "docs/calibration.md").read_text(encoding="utf-8")
    monkeypatch.chdir(tmp_path)
    exec(page.split("### Other formats")[1].split("```python")[1].split("```")[0], {})
    lenses = [np.r_[lens[:4], 0] for lens in PLUMB_BOB]
    assert_same(
        load_rig(tmp_path / "calib.yml"), rectify_eyes("calib", SIZE, K, (lenses[0], lenses[1]), R, T)
    )


# ---- which form, and from one to another -----------------------------------------------------------------


def test_what_was_looked_for_is_said(tmp_path: Path) -> None:
    message = refusal(tmp_path)
    for name in ("left.yaml and right.yaml", "calibrationdata.tar.gz", "intrinsics", "scikit-surgery"):
        assert name in message
    assert "gone/left.yaml; a rig is a folder with left.yaml and right.yaml" in refusal(tmp_path / "gone")


def test_convert(tmp_path: Path) -> None:
    folder = write_pair(tmp_path / "scope", ".yml", PLUMB_BOB, T * 1000)
    code, said = converted(folder, tmp_path / "out", "--unit", "mm")
    assert code == 0 and "baseline 5.2 mm" in said
    assert_same(load_rig(tmp_path / "out"), make_rig())
    code, said = converted(folder, tmp_path / "no")
    assert code == 2 and "looks like millimetres" in said and not (tmp_path / "no").exists()
    assert f"sags calib convert {folder} -o FOLDER --unit mm" in said
    code, said = converted(folder, tmp_path / "no", size="640")
    assert code == 2 and "'640' is not like 720x576" in said
    code, _ = converted(tmp_path / "out", tmp_path / "double", "--scale", "2", size=None)
    double, rig = load_rig(tmp_path / "double"), make_rig()
    assert code == 0 and (double.left.width, double.left.height) == (1280, 960)
    assert double.baseline == pytest.approx(rig.baseline)
    np.testing.assert_allclose(double.right.K, scale_intrinsics(rig.right.K, SIZE, (1280, 960)))
    np.testing.assert_allclose(double.T_right_left, rig.T_right_left, atol=1e-12)


# ---- what cannot be --------------------------------------------------------------------------------------


@pytest.mark.parametrize("text", ["- 1\n- 2\n", "", "a: [1, 2", "%YAML:1.0\n---\nM: 1\n", "\x00"])
def test_not_a_camera_info_file(folder: Path, text: str) -> None:
    (folder / "left.yaml").write_text(text)
    assert str(folder / "left.yaml") in refusal(folder)


UNKNOWN_MODELS = "equidistant", "thin_prism", 7, ["plumb_bob"], {"name": "plumb_bob"}


@pytest.mark.parametrize(
    ("key", "value"),  # None: the key is missing
    [
        *((key, None) for key in ("camera_matrix", "distortion_coefficients", "projection_matrix")),
        *(("image_width", value) for value in (None, 0, "640", True)),
        ("image_height", 10**9),
        ("distortion_model", "rational_polynomial"),  # of five coefficients
        *(("distortion_model", value) for value in UNKNOWN_MODELS),
        ("camera_matrix", {"data": [10**400, 0, 0, 0, 1, 0, 0, 0, 1]}),
        ("distortion_coefficients", {"data": [0.1] * 8}),
        ("camera_matrix", {"data": [1.0] * 8}),
        ("camera_matrix", [1.0] * 9),
        ("rectification_matrix", {"data": ["a"] * 9}),
        ("rectification_matrix", {"data": [True, 0, 0, 0, 1, 0, 0, 0, 1]}),
        ("roi", {"x_offset": False, "y_offset": 0, "width": True, "height": 480}),
        ("binning_x", True),
        ("projection_matrix", {"data": [[1.0, 2.0], 3.0] + [0.0] * 10}),
    ],
)
def test_wrong_value_is_named(folder: Path, key: str, value: Any) -> None:
    edit(folder, "left", {key: value})
    message = refusal(folder)
    said = f"{key} is missing" if value is None else {"roi": "x_offset"}.get(key, key)
    if value in UNKNOWN_MODELS:
        said = f"distortion_model: {value!r} is not supported"
    assert "left.yaml" in message and said in message


def exchanged(folder: Path) -> None:
    left, right = (folder / "left.yaml").read_text(), (folder / "right.yaml").read_text()
    (folder / "left.yaml").write_text(right)
    (folder / "right.yaml").write_text(left)


def with_matrix(side: str, name: str, matrix: F64) -> Callable[[Path], None]:
    return lambda folder: edit(folder, side, {f"{name}_matrix": {"data": matrix.ravel().tolist()}})


def with_P(row: int, column: int, factor: float, more: float = 0.0) -> Callable[[Path], None]:
    """A number of the right eye's projection is another."""
    P = make_rig().right.P.copy()
    P[row, column] = factor * P[row, column] + more
    return with_matrix("right", "projection", P)


K_LEFT = make_rig().left.K
SKEW = np.array([[0, 3.0, 0], [0, 0, 0], [0, 0, 0]])


@pytest.mark.parametrize(
    ("change", "said"),
    [
        (exchanged, "exchanged"),
        (with_P(0, 3, -1), r"must be -fx \* baseline"),
        (with_P(0, 3, 0), "no baseline"),
        (with_P(0, 3, 1000), "looks like millimetres.*divide"),
        (with_P(0, 3, 1 / make_rig().right.P[0, 0]), "too small.*by fx"),
        (with_P(1, 1, 1, 2), "rectified fy differs"),
        (with_P(1, 2, 1, 2), "rectified cy differs"),
        (with_P(0, 0, 1, 2), "rectified fx differs"),
        (lambda folder: edit(folder, "right", {"image_width": 720}), "same image size"),
        (with_matrix("left", "rectification", np.diag([1.0, 1, -1])), "not a rotation"),
        (with_matrix("left", "camera", K_LEFT / [[640], [640], [1]]), "not plausible"),  # of an image's width
        (with_matrix("left", "projection", np.zeros(12)), "all zeros.*one by"),
        (with_matrix("left", "camera", K_LEFT.T), "camera_matrix is transposed"),  # as MATLAB writes it
        # scaled as a whole for images of half the size
        (with_matrix("right", "camera", K_LEFT / 2), r"right.yaml: camera_matrix.* 0 0 0.5, not 0 0 1"),
        (with_P(2, 2, 0.5), r"right.yaml: projection_matrix.* 0 0 0.5, not 0 0 1"),
        (with_P(1, 0, 0, 2), "second row begins with 2"),
        (with_matrix("left", "camera", K_LEFT + SKEW), r"left.yaml: camera_matrix: its skew of 3 px"),
        (with_P(0, 1, 0, 3), r"right.yaml: projection_matrix: its skew of 3 px"),
        (with_P(1, 3, 0, -3), r"projection_matrix\[7\] and \[11\] are -3 and 0"),  # one above the other
        (with_P(2, 3, 0, 0.1), r"projection_matrix\[7\] and \[11\] are 0 and 0.1"),
    ],
    ids=lambda value: value if isinstance(value, str) else "",
)
def test_eyes_that_cannot_be(folder: Path, change: Callable[[Path], None], said: str) -> None:
    change(folder)
    with pytest.raises(UsageError, match=said):
        load_rig(folder)
    levels = [finding.level for finding in check_rig(read_rig(folder))]
    assert "error" in levels  # it can be read, to be reported on


def test_a_skew_that_moves_nothing_and_rounding_are_no_fault(folder: Path) -> None:
    with_matrix("left", "camera", K_LEFT + 0.01 * SKEW + np.diag([0, 0, 1e-9]))(folder)
    load_rig(folder)


def test_a_rectification_of_another_size_is_told(folder: Path) -> None:
    for side, eye in (("left", make_rig().left), ("right", make_rig().right)):
        with_matrix(side, "projection", np.diag([0.5, 0.5, 1]) @ eye.P)(folder)
    said = [each.what for each in check_rig(load_rig(folder)) if each.level == "warning"]
    assert len(said) == 1 and "at 0.5 of the middle: projection_matrix is of" in said[0]


def test_unusual_baseline_is_only_a_warning(folder: Path) -> None:
    with_P(0, 3, 10)(folder)
    findings = check_rig(load_rig(folder))
    assert [finding.what for finding in findings if finding.level == "warning"] == [
        "a baseline of 52 mm is unusual for a stereo endoscope (3 to 10 mm)"
    ]


@pytest.mark.parametrize("planted", [float("nan"), float("inf")])
@pytest.mark.parametrize("field", ["K", "distortion", "R", "P"])
def test_numbers_that_are_not_finite(field: str, planted: float) -> None:
    rig = make_rig()
    values = getattr(rig.left, field).copy()
    values.flat[0] = planted
    bad = replace(rig, left=replace(rig.left, **{field: values}))
    assert [finding.level for finding in check_rig(bad)] == ["error"]
