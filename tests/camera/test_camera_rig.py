"""Files of several cameras, beside independent readings of them."""

from pathlib import Path

import cv2
import numpy as np
import pytest
import torch
import yaml

import torchpose as tp
from torchpose.geometry import rotations

F64 = torch.float64


def three() -> tp.CameraRig:
    """Three cameras of three kinds, with covariances."""
    g = torch.Generator().manual_seed(3)
    cameras = [
        tp.Camera(1824, 1216, [[1111.5, 0, 911.25], [0, 1110.75, 607.5], [0, 0, 1]], [-0.1, 0.02, 1e-4, -2e-4]),
        tp.Camera(640, 480, [[500.0, 0, 320], [0, 501, 240], [0, 0, 1]], [0.01, -0.02, 0, 0], "kannala_brandt"),
        tp.Camera(
            1920,
            1080,
            [[1500.0, 0, 960], [0, 1500, 540], [0, 0, 1]],
            [-0.1, 0.02, 1e-4, -2e-4, 0.003],
            covariance=torch.diag(torch.rand(9, dtype=F64, generator=g)),
        ),
    ]
    R = rotations.exp(torch.tensor([[0.0, 0, 0], [0.0, 0.7, 0.1], [-0.2, -0.6, 0.4]], dtype=F64))
    t = torch.tensor([[0.0, 0, 0], [-150.25, 3.5, 40.125], [140, 1 / 3, 55]], dtype=F64)
    root = 0.01 * torch.randn(12, 12, dtype=F64, generator=g)
    return tp.CameraRig(cameras, R, t, root @ root.mT, ["left", "cam1", "top"])


def kalibr_by_hand(path: Path) -> list[tuple[np.ndarray, list[float], list[float]]]:
    """What Kalibr's `CameraChainParameters` takes of a camchain: every key of the file is a camera."""
    data = yaml.safe_load(path.read_text())
    chain, places = np.eye(4), []
    for n in range(len(data)):  # as Kalibr counts cameras: a further key at the top would be one
        entry = data[f"cam{n}"]
        if n:
            chain = np.array(entry["T_cn_cnm1"]) @ chain
        places.append((chain.copy(), entry["intrinsics"], entry["resolution"]))
    return places


def test_what_is_saved_is_read_again(tmp_path: Path) -> None:
    rig, path = three(), tmp_path / "rig.yaml"
    rig.save(path)
    again = tp.CameraRig.load(path)
    assert again.names == rig.names
    torch.testing.assert_close(again.R, rig.R, rtol=0, atol=1e-15)
    torch.testing.assert_close(again.t, rig.t, rtol=1e-14, atol=1e-12)
    assert rig.covariance is not None
    assert again.covariance is not None
    torch.testing.assert_close(again.covariance, rig.covariance, rtol=0, atol=0)
    for one, other in zip(rig.cameras, again.cameras, strict=True):
        assert (one.width, one.height, one.model) == (other.width, other.height, other.model)
        assert torch.equal(one.matrix, other.matrix)
        assert torch.equal(one.distortion, other.distortion)
    assert torch.equal(again.cameras[2].covariance, rig.cameras[2].covariance)  # type: ignore[arg-type]
    assert tp.Camera.load(f"{path}#cam1").model == "kannala_brandt"  # one of them alone


def test_an_independent_reader_of_camchains_agrees(tmp_path: Path) -> None:
    rig, path = three(), tmp_path / "rig.yaml"
    rig.save(path)
    read = kalibr_by_hand(path)
    assert len(read) == 3
    for n, (place, intrinsics, resolution) in enumerate(read):
        np.testing.assert_allclose(place[:3, :3], rig.R[n].numpy(), atol=1e-14)
        np.testing.assert_allclose(1000 * place[:3, 3], rig.t[n].numpy(), atol=1e-10)
        k = rig.cameras[n].matrix
        assert intrinsics == [float(k[0, 0]), float(k[1, 1]), float(k[0, 2]), float(k[1, 2])]
        assert resolution == [rig.cameras[n].width, rig.cameras[n].height]


def test_opencv_stereo(tmp_path: Path) -> None:
    rig = three()
    path = tmp_path / "stereo.yml"
    storage = cv2.FileStorage(str(path), cv2.FILE_STORAGE_WRITE)
    for n in (1, 2):
        storage.write(f"M{n}", rig.cameras[0].matrix.numpy())
        storage.write(f"D{n}", rig.cameras[0].distortion.numpy()[None])
    storage.write("R", rig.R[1].numpy())
    storage.write("T", rig.t[1].numpy()[:, None] / 1000)
    storage.write("image_width", 1824)
    storage.write("image_height", 1216)
    storage.release()
    with pytest.raises(tp.ConfigError, match=r"stereo.yml: units: missing; write the unit of T, mm or m"):
        tp.CameraRig.load(path)
    text = path.read_text()
    path.write_text(text + "units: [m]\n")
    with pytest.raises(tp.ConfigError, match=r"stereo.yml: units: a list of 1; write the unit of T, mm or m"):
        tp.CameraRig.load(path)
    path.write_text(text + "units: m\n")
    found = tp.CameraRig.load(path)
    torch.testing.assert_close(found.t, rig.t[:2], rtol=1e-12, atol=1e-12)
    torch.testing.assert_close(found.R, rig.R[:2], rtol=0, atol=1e-14)
    text = path.read_text()
    path.write_text(text + "fisheye: 1\n")
    assert {camera.model for camera in tp.CameraRig.load(path).cameras} == {"kannala_brandt"}
    path.write_text(text + "# stereo of two fisheyes\n")
    with pytest.raises(tp.ConfigError, match=r"stereo.yml: camera 1: distortion_model: is missing, and the file"):
        tp.CameraRig.load(path)
    path.write_text(text.replace("1111.5,", "1.1115,"))
    with pytest.raises(tp.ConfigError, match=r"stereo.yml: cam0.camera_matrix: .* an impossible field of view"):
        tp.CameraRig.load(path)


def test_lenses_without_rays_are_told_of_a_rig_too(tmp_path: Path) -> None:
    camera = tp.Camera(640, 480, [[300.0, 0, 320], [0, 300, 240], [0, 0, 1]], [-0.9, 0, 0, 0])
    rig = tp.CameraRig([tp.Camera.ideal(640, 480, 500.0), camera], torch.eye(3).expand(2, 3, 3), torch.zeros(2, 3))
    rig.save(tmp_path / "rig.yaml")
    with pytest.warns(UserWarning, match=r"rig.yaml: cam1.distortion_coefficients: no ray reaches \d+ % of the frame"):
        tp.CameraRig.load(tmp_path / "rig.yaml")


def moved(parent: str, child: str, x: float) -> dict[str, object]:
    where = {"translation": {"x": x, "y": 0.0, "z": 0.0}, "rotation": {"x": 0.0, "y": 0.0, "z": 0.0, "w": 1.0}}
    return {"header": {"frame_id": parent}, "child_frame_id": child, "transform": where}


def ros_folder(folder: Path, frames: tuple[str, str], *messages: list[dict[str, object]]) -> Path:
    """Two camera_info files, and what `ros2 topic echo /tf_static` prints of several messages."""
    for name, frame in zip(("left", "right"), frames, strict=True):
        tp.Camera.ideal(640, 480, 500.0).save(folder / f"{name}.yaml", "ros")
        text = (folder / f"{name}.yaml").read_text()
        (folder / f"{name}.yaml").write_text(text.replace("camera_name: camera", f"camera_name: {frame}"))
    text = "".join(yaml.safe_dump({"transforms": message}) + "---\n" for message in messages)
    (folder / "tf_static.yaml").write_text(text)
    return folder


def test_transforms_of_several_messages_are_one_tree(tmp_path: Path) -> None:
    ros_folder(tmp_path, ("l", "r"), [moved("base", "l", 0.1)], [moved("base", "arm", 0.5)], [moved("arm", "r", 0.25)])
    rig = tp.CameraRig.load(tmp_path)
    assert rig.names == ("left", "right")
    assert rig.t[1].tolist() == pytest.approx([-650.0, 0.0, 0.0])  # X_right = X_left + 0.1 - 0.5 - 0.25, in m


@pytest.mark.parametrize(
    ("frames", "transforms", "message"),
    [
        (("l", "r"), [moved("b", "l", 0), moved("b", "r", 1), moved("b", "r", 2)], "r stands in two that differ; keep"),
        (("l", "r"), [moved("b", "l", 0), moved("c", "r", 1), moved("b", "r", 1)], "r stands in two that differ; keep"),
        (("l", "r"), [moved("l", "r", 1), moved("r", "l", 1)], "those above r lead back to r; a tree has no loop"),
        (("l", "l"), [moved("b", "l", 0)], r"right.yaml: header.frame_id: is 'l', as in left.yaml; give every camera"),
    ],
)
def test_transforms_that_contradict_each_other_are_refused(
    tmp_path: Path, frames: tuple[str, str], transforms: list[dict[str, object]], message: str
) -> None:
    with pytest.raises(tp.ConfigError, match=message):
        tp.CameraRig.load(ros_folder(tmp_path, frames, transforms))


def test_ros_folder(tmp_path: Path) -> None:
    rig = three()
    base = rotations.exp(torch.tensor([0.3, -0.2, 1.0], dtype=F64)), torch.tensor([500.0, 20, -70], dtype=F64)
    transforms = []
    for n, name in enumerate(rig.names):
        rig.cameras[n].save(tmp_path / f"{name}.yaml", "ros")
        text = (tmp_path / f"{name}.yaml").read_text().replace("camera_name: camera", f"camera_name: {name}")
        (tmp_path / f"{name}.yaml").write_text(text)
        # X_base = base (X_0), X_n = R_n X_0 + t_n
        turn, shift = rotations.compose(*base, *rotations.inverse(rig.R[n], rig.t[n]))
        w, x, y, z = rotations.quaternion(turn).tolist()
        where = dict(zip("xyz", (shift / 1000).tolist(), strict=True))
        moved = {"translation": where, "rotation": {"x": x, "y": y, "z": z, "w": w}}
        transforms.append(
            {"header": {"frame_id": "base"}, "child_frame_id": f"{name}_optical_frame", "transform": moved}
        )
    (tmp_path / "tf_static.yaml").write_text(yaml.safe_dump({"transforms": transforms}))
    found = tp.CameraRig.load(tmp_path)
    order = [found.names.index(name) for name in ("cam1", "left", "top")]
    assert order == [0, 1, 2]  # by name; the first one is the reference
    R, t = rotations.compose(rig.R[2], rig.t[2], *rotations.inverse(rig.R[1], rig.t[1]))
    torch.testing.assert_close(found.R[2], R, rtol=0, atol=1e-12)
    torch.testing.assert_close(found.t[2], t, rtol=0, atol=1e-9)


@pytest.mark.parametrize(
    ("old", "new", "message"),
    [
        ("T_cn_cnm1", "T_cam_imu", r"cam1.T_cn_cnm1: is missing; give the 4 x 4 transform"),
        ("cam2:", "cam3:", r"cam3: stands beside cam0, cam1; number the cameras"),
        ("    - [0.0, 0.0, 0.0, 1.0]", "    - [0.0, 0.0, 0.0, 2.0]", r"cam1.T_cn_cnm1: has the last row"),
        ('  name: "top"\n', "  name: left\n", r"names: left, cam1, left; give every one"),
        ('  name: "top"\n', '  name: ".."\n', r"names: '..' is no name of a folder, which pictures of a camera lie in"),
        ('  name: "top"\n', '  name: "a/b"\n', r"names: 'a/b' is no name of a folder"),
        ("  extrinsics_covariance:\n    - [", "  other:\n    - [", r"extrinsics_covariance: is missing, and cam2"),
        ("  extrinsics_covariance:\n    - [", "  extrinsics_covariance:\n    - [1.0, ", r"rows differ in length"),
    ],
)
def test_one_line_for_every_mistake(tmp_path: Path, old: str, new: str, message: str) -> None:
    path = tmp_path / "rig.yaml"
    three().save(path)
    text = path.read_text()
    assert old in text
    path.write_text(text.replace(old, new, 1))
    with pytest.raises(tp.ConfigError, match=message) as caught:
        tp.CameraRig.load(path)
    assert str(caught.value).startswith(f"{path}: ")
    assert "\n" not in str(caught.value)


def test_places_are_checked() -> None:
    camera = tp.Camera.ideal(640, 480, 500.0)
    eye = torch.eye(3, dtype=F64).expand(2, 3, 3)
    with pytest.raises(tp.ConfigError, match="R, t: those of the first camera"):
        tp.CameraRig([camera, camera], eye, torch.ones(2, 3, dtype=F64))
    with pytest.raises(tp.ConfigError, match="is a reflection"):
        tp.CameraRig([camera, camera], torch.stack([eye[0], -eye[0]]), torch.zeros(2, 3, dtype=F64))
    with pytest.raises(tp.ConfigError, match="extrinsics_covariance: has a negative eigenvalue"):
        tp.CameraRig([camera, camera], eye, torch.zeros(2, 3, dtype=F64), -torch.eye(6, dtype=F64))


def test_places_vary_as_the_covariance_says() -> None:
    rig = three()
    factor = rig.factor()
    assert not bool(factor[0].any())
    whole = factor[1:].flatten(0, 1)
    torch.testing.assert_close(whole @ whole.mT, rig.covariance, rtol=1e-9, atol=1e-12)
