"""Every form of calibration file is written here by others' means, and read back."""

import gzip
import re
import tarfile
from pathlib import Path

import cv2
import numpy as np
import pytest
import yaml
from command_line import ran
from packed import pack
from places import ROOT
from test_calibration import PLUMB_BOB, SIZE, K, R, T, make_rig

from sags_node.config.units import UNITS
from sags_node.errors import UsageError
from sags_node.geometry import scale_intrinsics
from sags_node.rig import check_rig, load_rig, read_rig, rectify_eyes, resized_rig, save_rig
from sags_node.types import F64, StereoRig

MATRICES = {"M1": K[0], "D1": PLUMB_BOB[0], "M2": K[1], "D2": PLUMB_BOB[1], "R": R, "T": T}
RATIONAL = (
    np.array([0.3, 0.1, 1e-3, -5e-4, 0.02, 0.5, 0.2, 0.01]),
    np.array([0.2, 0.1, -1e-3, 4e-4, 0.01, 0.4, 0.2, 0.02]),
)


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


def converted(folder: Path, out: Path, *more: str, size: str | None = "640x480") -> tuple[int, str]:
    """The exit code of `sags calib convert`, and what it says."""
    asked = () if size is None else ("--size", size)
    code, _, said = ran("calib", "convert", folder, "-o", out, *asked, *more)
    return code, said


# ---- ROS -------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("model", "distortion"), [("plumb_bob", PLUMB_BOB), ("rational_polynomial", RATIONAL)]
)
def test_ros_files_and_one_that_stands_for_both(
    model: str, distortion: tuple[F64, F64], tmp_path: Path
) -> None:
    save_rig(make_rig(distortion), tmp_path / "rig")
    tree = yaml.safe_load((tmp_path / "rig/left.yaml").read_text())
    assert tree["distortion_model"] == model
    for path in (tmp_path / "rig", tmp_path / "rig/right.yaml"):
        assert load_rig(path).name == "rig"
        assert_same(load_rig(path), make_rig(distortion), 0)


@pytest.mark.parametrize("model", ["equidistant", "thin_prism", 7])
def test_models_that_are_not_read(tmp_path: Path, model: object) -> None:
    save_rig(make_rig(), tmp_path)
    tree = yaml.safe_load((tmp_path / "left.yaml").read_text()) | {"distortion_model": model}
    (tmp_path / "left.yaml").write_text(yaml.safe_dump(tree))
    assert f"distortion_model: {model!r} is not supported" in refusal(tmp_path)


def echoed(rig: StereoRig, names: str = "dkrp", **more: object) -> dict[str, str]:
    """What `topic echo` prints of the camera_info of both eyes; ROS 1 has capitals."""
    d, k, r, p = names
    return {
        f"{side}.yaml": yaml.safe_dump(
            {
                "header": {"stamp": {"sec": 3, "nanosec": 5}, "frame_id": side},
                **{"height": eye.height, "width": eye.width, "distortion_model": "plumb_bob"},
                **{d: eye.distortion.tolist(), k: eye.K.ravel().tolist()},
                **{r: eye.R.ravel().tolist(), p: eye.P.ravel().tolist()},
                **{"binning_x": 0, "binning_y": 0, **more},
            }
        )
        + "---\n"
        for side, eye in (("left", rig.left), ("right", rig.right))
    }


@pytest.mark.parametrize("names", ["dkrp", "DKRP"])
@pytest.mark.parametrize("copies", [1, 2])
def test_what_topic_echo_prints(tmp_path: Path, names: str, copies: int) -> None:
    for name, text in echoed(make_rig(), names).items():
        (tmp_path / name).write_text(text * copies)
    assert_same(load_rig(tmp_path), make_rig(), 0)
    for name, text in echoed(make_rig(), names, binning_x=2, binning_y=2).items():
        (tmp_path / name).write_text(text)
    assert_same(load_rig(tmp_path), resized_rig(make_rig(), 0.5))


def test_coefficients_without_commas(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    for name, text in ros_files.items():
        tree = yaml.safe_load(text)
        for value in tree.values():
            if isinstance(value, dict):
                value["data"] = [" ".join(map(str, value["data"]))]
        (tmp_path / name).write_text(yaml.safe_dump(tree | {"distortion_model": "radtan"}))
    assert_same(load_rig(tmp_path), make_rig(), 0)


@pytest.fixture
def ros_files(tmp_path: Path) -> dict[str, bytes]:
    save_rig(make_rig(), tmp_path / "written")
    return {name: (tmp_path / "written" / name).read_bytes() for name in ("left.yaml", "right.yaml")}


def test_archive_of_ros_camera_calibration(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    pictures = {f"left-{index:04d}.png": bytes(5000) for index in range(3)}
    file = pack(tmp_path / "calibrationdata.tar.gz", pictures | ros_files | {"ost.txt": b"# oST"})
    for path in (file, tmp_path):  # the file, and the folder that holds it
        read = load_rig(path)
        assert_same(read, make_rig(), 0)
    assert load_rig(file).name == "calibrationdata"


def test_an_archive_writes_nothing_outside(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    inside = tmp_path / "deep/er"
    inside.mkdir(parents=True)
    file = pack(inside / "data.tgz", {f"../../{name}": text for name, text in ros_files.items()})
    before = sorted(tmp_path.rglob("*"))
    assert_same(load_rig(file), make_rig(), 0)
    assert sorted(tmp_path.rglob("*")) == before


def test_archives_that_are_refused(tmp_path: Path, ros_files: dict[str, bytes]) -> None:
    one_eye = pack(tmp_path / "one.tar.gz", {"left.yaml": ros_files["left.yaml"]})
    assert "holds no right.yaml" in refusal(one_eye)
    large = pack(tmp_path / "large.tar.gz", {"left.yaml": b" " * (2**20 + 1)})
    assert "larger than" in refusal(large)
    (tmp_path / "cut.tar.gz").write_bytes(pack(tmp_path / "whole.tar.gz", ros_files).read_bytes()[:200])
    assert "cut.tar.gz is not a readable tar.gz" in refusal(tmp_path / "cut.tar.gz")
    assert "is not a readable tar.gz" in refusal(tmp_path / "gone.tar.gz")


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


@pytest.mark.parametrize(
    "said",
    [
        {"fisheye_model": 1},
        {"use_fisheye": "yes"},
        {"model": "fisheye"},
        {"distortion_model": "equidistant"},
        {"camera_model": "KannalaBrandt8"},
        {"cameraModel": "omnidirectional"},
        {"xi": 1.2},
    ],
    ids=str,
)
def test_other_models_of_opencv_files_are_refused(tmp_path: Path, said: dict[str, object]) -> None:
    """By what the file says of itself; what says that it is of no other model is read."""
    folder = write_pair(tmp_path / "rig", ".yml", PLUMB_BOB, T)
    key, intrinsics = next(iter(said)), folder / "intrinsics.yml"
    text = intrinsics.read_text()
    intrinsics.write_text(f"{text}{key}: {said[key]}\n")
    assert f"{key}: {said[key]} is not supported" in refusal(folder, SIZE)
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


@pytest.mark.parametrize(("said", "baseline"), [("cm", 0.06), ("inch", 0.09), ("m", 0.15)])
@pytest.mark.parametrize("form", ["OpenCV", "ROS"])
def test_a_rig_that_is_no_endoscope_is_taken_as_the_refusal_says(
    form: str, said: str, baseline: float, tmp_path: Path
) -> None:
    """Its baseline reads as that of an endoscope in another unit, which does not make it one."""
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
    if said != "m":  # as where no unit is said
        assert code == 2 and f"--unit {said} makes the baseline {1e3 * baseline:g} mm" in text
        (factor,) = re.findall(r"divide the baseline in the files by (\S+) .*, and say --unit m$", text, re.M)
        code, text = in_unit(UNITS[said] * float(factor), "m")
    assert code == 0, text
    assert load_rig(tmp_path / "out").baseline == pytest.approx(baseline, rel=1e-5)


def test_a_unit_that_no_other_one_betters_is_taken(tmp_path: Path) -> None:
    """20 mm: of no endoscope in any unit."""
    folder = write_pair(tmp_path / "rig", ".yml", PLUMB_BOB, T * 20 / 5.2e-3)
    code, text = converted(folder, tmp_path / "out", "--unit", "mm")
    assert code == 0 and "baseline 20 mm" in text


@pytest.mark.parametrize(
    ("names", "size"),
    [
        (("M1", "D1", "M2", "D2"), {"image_width": 640, "image_height": 480}),
        (("K1", "D1", "K2", "D2"), {"imageSize": (640, 480)}),
        (("cameraMatrix1", "distCoeffs1", "cameraMatrix2", "distCoeffs2"), {"image_size": (640, 480)}),
        (("KL", "DL", "KR", "DR"), {"width": 640, "height": 480}),
    ],
)
def test_one_opencv_file(tmp_path: Path, names: tuple[str, ...], size: dict[str, object]) -> None:
    values = K[0], PLUMB_BOB[0], K[1], PLUMB_BOB[1]
    matrices = dict(zip(names, values, strict=True)) | {"R": R, "T": T} | size
    read = read_rig(write(tmp_path / "scope_a.yaml", matrices))
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


@pytest.mark.parametrize(
    "text",
    [
        "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 100000\n   cols: 1000000\n   dt: d\n   data: [ 1. ]\n",
        "%YAML:1.0\n---\nM1: !!opencv-matrix\n   rows: 3\n   cols: 3\n   dt: d\n   data: [ 1., 2. ]\n",
        "%YAML:1.0\n---\nM1: [ 1, 2\n",
        "%YAML:1.0\n---\n-\nM1: [ 1, 2 ]\n",  # a list, of which OpenCV asks names all the same
        "<?xml version='1.0'?><opencv_storage><M1>",
    ],
)
def test_damaged_opencv_files(tmp_path: Path, text: str) -> None:
    file = tmp_path / ("rig.xml" if text.startswith("<") else "rig.yml")
    file.write_text(text)
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
    (folder / "calib.left.distortion.txt").write_text("a b c d e")
    assert "calib.left.distortion.txt holds something else than numbers" in refusal(folder, SIZE)
    (folder / "calib.left.distortion.txt").unlink()
    assert "*left.distortion*.txt is needed, found: none" in refusal(folder, SIZE)
    np.savetxt(folder / "calib.left.distortion.txt", np.zeros(3))
    assert "holds 3 numbers" in refusal(folder, SIZE)
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
    assert "gone/left.yaml" in refusal(tmp_path / "gone")


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
