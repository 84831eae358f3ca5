"""BVH files: forward kinematics by hand, every kind of well-formed file, and clear words for the others."""

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

from nrsfm_lite import datasets
from nrsfm_lite.datasets.skeleton import forward_kinematics, kept_edges

ARM = """HIERARCHY
ROOT shoulder
{
  OFFSET 0 1 0
  CHANNELS 6 Xposition Yposition Zposition Zrotation Xrotation Yrotation
  JOINT elbow
  {
    OFFSET 2 0 0
    CHANNELS 3 Zrotation Yrotation Xrotation
    End Site
    {
      OFFSET 1 0 0
    }
  }
}
MOTION
Frames: 2
Frame Time: 0.0333
0 1 0  0 0 0   0 0 0
5 6 7  90 0 0  90 0 0
"""


@pytest.fixture
def arm(tmp_path):
    file = tmp_path / "arm.bvh"
    file.write_text(ARM)
    return file


def test_forward_kinematics_by_hand(arm):
    data = datasets.load_bvh(arm)
    assert data.names == ("shoulder", "elbow", "elbow_end") and data.edges.tolist() == [[0, 1], [1, 2]]
    np.testing.assert_allclose(data.points3d[0], [[0, 1, 0], [2, 1, 0], [3, 1, 0]], atol=1e-12)
    # The upper arm turns from x to y; the forearm once more, from y to -x.
    np.testing.assert_allclose(data.points3d[1], [[5, 6, 7], [5, 8, 7], [4, 8, 7]], atol=1e-12)


def test_forward_kinematics_against_a_walk_along_each_chain(rng):
    parents = [-1, 0, 1, 1, 0, 4]
    offsets = rng.normal(size=(6, 3))
    rotations = Rotation.random(3 * 6, rng=rng).as_matrix().reshape(3, 6, 3, 3)
    positions = forward_kinematics(parents, offsets, rotations)
    for f in range(3):
        for j in range(6):
            point, k = offsets[j], parents[j]
            while k >= 0:
                point, k = rotations[f, k] @ point + offsets[k], parents[k]
            np.testing.assert_allclose(positions[f, j], point)


@pytest.mark.parametrize("order", ["XYZ", "XZY", "YXZ", "YZX", "ZXY", "ZYX"])
def test_rotation_channels_act_in_the_order_they_are_listed(arm, order):
    channels = " ".join(f"{axis}rotation" for axis in order)
    arm.write_text(ARM.replace("Zrotation Xrotation Yrotation", channels).replace("90 0 0  90 0 0", "20 30 40  0 0 0"))
    turned = {
        a: Rotation.from_euler(a.lower(), v, degrees=True).as_matrix() for a, v in zip(order, (20, 30, 40), strict=True)
    }
    expected = turned[order[0]] @ turned[order[1]] @ turned[order[2]] @ [2, 0, 0] + [5, 6, 7]
    np.testing.assert_allclose(datasets.load_bvh(arm).points3d[1, 1], expected)


def test_other_spellings_are_well_formed_too(arm):
    """Lower case, Windows line ends, tabs, one rotation channel, motion broken over lines, no last newline."""
    text = ARM.replace("Zrotation Yrotation Xrotation", "Zrotation").replace("CHANNELS 3 Z", "CHANNELS 1 Z")
    text = (
        text.replace("0 0 0   0 0 0", "0 0 0   0")
        .replace("90 0 0  90 0 0", "90 0 0  90")
        .replace("  OFFSET", "\tOFFSET")
    )
    arm.write_bytes(text.strip().replace("ROOT", "root").replace("End Site", "END SITE").replace("\n", "\r\n").encode())
    np.testing.assert_allclose(datasets.load_bvh(arm).points3d[1], [[5, 6, 7], [5, 8, 7], [4, 8, 7]], atol=1e-12)
    arm.write_text(ARM.replace("5 6 7  90 0 0", "5 6 7\n90 0 0"))
    np.testing.assert_allclose(datasets.load_bvh(arm).points3d[1, 2], [4, 8, 7], atol=1e-12)


def test_position_channels_of_a_joint_replace_its_offset(arm):
    arm.write_text(
        ARM.replace("CHANNELS 3 Zrotation Yrotation Xrotation", "CHANNELS 1 Xposition")
        .replace("0 0 0   0 0 0", "0 0 0   2")
        .replace("90 0 0  90 0 0", "0 0 0  9")
    )
    np.testing.assert_allclose(datasets.load_bvh(arm).points3d[1, 1], [14, 6, 7])


def test_joints_and_every(arm):
    data = datasets.load_bvh(arm, joints=["elbow_end", "shoulder"], every=2)
    assert data.names == ("elbow_end", "shoulder") and len(data) == 1
    assert data.edges.tolist() == [[1, 0]]  # the dropped elbow is bridged
    with pytest.raises(KeyError, match="no joint named wrist"):
        datasets.load_bvh(arm, joints=["wrist"])
    for every in (0, 1.5, "2", True):
        with pytest.raises(ValueError, match="every="):
            datasets.load_bvh(arm, every=every)
    for joints, message in [((), "joints is empty"), (("elbow", "elbow"), "joints has 'elbow' twice")]:
        with pytest.raises(ValueError, match=message):
            datasets.load_bvh(arm, joints=joints)


def test_edges_bridge_what_is_dropped():
    assert kept_edges([-1, 0, 1, 2, 2], [0, 3, 4]).tolist() == [[0, 1], [0, 2]]


def test_two_end_sites_under_one_joint_are_two_points(arm):
    second = "    End Site\n    {\n      OFFSET 0 9 0\n    }\n"
    arm.write_text(ARM.replace("    End Site", second + "    End Site"))
    data = datasets.load_bvh(arm)
    assert data.names[2:] == ("elbow_end", "elbow_end_2")
    np.testing.assert_allclose(data.points3d[0, 2:], [[2, 10, 0], [3, 1, 0]], atol=1e-12)


def chain(*labels):
    """A file of one chain of joints with these labels, each with an end site of its own."""
    text = "HIERARCHY\n"
    for i, label in enumerate(labels):
        text += f"{'JOINT' if i else 'ROOT'} {label}\n{{\n OFFSET 1 0 0\n CHANNELS 1 Xposition\n"
        text += " End Site\n {\n  OFFSET 0 1 0\n }\n"
    return text + "}\n" * len(labels) + f"MOTION\nFrames: 1\nFrame Time: .01\n{'0 ' * len(labels)}\n"


@pytest.mark.parametrize(
    ("labels", "joints"),
    [
        (("hand", "hand"), ["hand", "hand_2"]),
        (("a", "a_3", "a"), ["a", "a_3", "a_2"]),
        (("a", "a_3", "a", "a"), ["a", "a_3", "a_2", "a_4"]),
        (("a", "a", "a_2"), ["a", "a_3", "a_2"]),
        (("a", "a", "a_2", "a"), ["a", "a_3", "a_2", "a_4"]),
        (("a", "a_end"), ["a", "a_end"]),
    ],
)
def test_joints_of_one_name_are_counted(arm, labels, joints):
    arm.write_text(chain(*labels))
    names = datasets.load_bvh(arm).names
    assert len(set(names)) == len(names)
    assert list(names[::2]) == joints
    ends = [f"{j}_end" for j in joints]
    assert list(names[1::2]) == [f"{e}_2" if e in joints else e for e in ends]


def test_time_is_that_of_each_file(arm, tmp_path):
    assert datasets.load_bvh(arm).time.tolist() == [0, 0.0333]
    (tmp_path / "slow.bvh").write_text(ARM.replace("0.0333", "0.5"))
    assert datasets.load_bvh(tmp_path).time.tolist() == [0, 0.0333, 0, 0.5]
    arm.write_text(ARM.replace("Frames: 2", "Frames: 4") + 2 * "1 1 1  0 0 0  0 0 0\n")
    np.testing.assert_allclose(datasets.load_bvh(arm, every=3).time, [0, 3 * 0.0333])
    (tmp_path / "slow.bvh").write_text(ARM.replace("0.0333", "0"))
    assert datasets.load_bvh(tmp_path).time is None


def test_a_byte_order_mark_is_no_obstacle(arm):
    arm.write_text(ARM, encoding="utf-8-sig")
    assert len(datasets.load_bvh(arm, every=2.0)) == 1


def test_a_folder_and_a_list(arm, tmp_path):
    (tmp_path / "b.bvh").write_text(ARM)
    (tmp_path / "notes.txt").write_text("not a motion")
    for source in (tmp_path, [arm, tmp_path / "b.bvh"]):
        data = datasets.load_bvh(source)
        assert len(data) == 4 and data.sequence.tolist() == [0, 0, 1, 1]
    (tmp_path / "b.bvh").write_text(ARM.replace("elbow", "knee"))
    with pytest.raises(ValueError, match="other joints than"):
        datasets.load_bvh(tmp_path)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("", "the file is empty"),
        ("Dear diary,\ntoday", "line 1: not a BVH file"),
        (ARM[: ARM.index("MOTION")], "line 15: the file ends inside the hierarchy"),
        (ARM[:120], "ends inside the hierarchy|unexpected|expected"),
        (ARM.replace("OFFSET 2 0 0", "OFFSET 2 zero 0"), "line 8: expected a number, found 'zero'"),
        (ARM.replace("Xposition", "Wposition"), "line 5: unknown channel 'wposition'"),
        (ARM.replace("JOINT", "JOYNT"), "line 6: unexpected 'JOYNT'"),
        (ARM.replace("JOINT", "ROOT"), "line 6: ROOT in the wrong place"),
        (ARM.replace("Frames: 2", "Frames: two"), "line 17: expected 'Frames: n'"),
        (ARM.replace("Frames: 2", "Frames: 0"), "line 17: the file has no frames"),
        (ARM.replace("Frame Time", "Time"), "line 18: expected 'Frame Time"),
        (ARM.replace("Frames: 2", "Frames: 3"), "line 20: 2 frames of motion, but 'Frames: 3'"),
        (ARM.replace("5 6 7  90 0 0  90 0 0", "5 6 7  90"), "line 20: 4 values, expected 9"),
        (ARM.replace("5 6 7", "5 six 7"), "line 20: expected a number, found 'six'"),
        (ARM.replace("5 6 7", "5 nan 7"), "line 20: a motion value is nan"),
        (ARM.replace("OFFSET 2 0 0", "OFFSET 2 nan 0"), "line 8: expected a number, found 'nan'"),
        (ARM.replace("CHANNELS 6", "CHANNELS 6.5"), "line 5: expected a whole number of channels, found 6.5"),
        (ARM.replace("0.0333", "soon"), "line 18: expected 'Frame Time"),
        (ARM.replace("CHANNELS 6", "CHANNELS inf"), "line 5: expected a number, found 'inf'"),
        (
            ARM.replace("Zrotation Yrotation Xrotation", "Zrotation Zrotation Xrotation"),
            "line 9: a channel is named twice",
        ),
        (ARM + "1 1 1  0 0 0  0 0 0\n", "line 21: 3 frames of motion, but 'Frames: 2' promised.$"),
    ],
)
def test_broken_files_are_refused_with_file_and_line(arm, text, message):
    arm.write_text(text)
    with pytest.raises(ValueError, match=message) as caught:
        datasets.load_bvh(arm)
    assert str(arm) in str(caught.value)


def test_files_that_are_not_there(tmp_path):
    with pytest.raises(FileNotFoundError, match="no such file"):
        datasets.load_bvh(tmp_path / "none.bvh")
    with pytest.raises(FileNotFoundError, match=r"no \.bvh file in this folder"):
        datasets.load_bvh(tmp_path)
    with pytest.raises(ValueError, match="an empty list"):
        datasets.load_bvh([])
    with pytest.raises(ValueError, match="expected a sequence of names"):
        datasets.load_bvh(tmp_path, joints="hip")


@pytest.mark.realdata
def test_real_motion_capture_is_a_person(real_data):
    file = real_data / "cmu_bvh" / "martial" / "04.bvh"
    if not file.exists():
        pytest.skip("the CMU motions are not in NRSFM_DATA")
    data = datasets.load_bvh(file, joints=datasets.CMU_BODY, every=10)
    assert data.n_points == 31 and len(data.edges) == 30
    # Bones keep their lengths, left and right legs are alike, and the head is above the feet.
    lengths = np.linalg.norm(data.points3d[:, data.edges[:, 0]] - data.points3d[:, data.edges[:, 1]], axis=2)
    inner = [i for i, (a, b) in enumerate(data.edges) if "hip" not in data.names[a]]
    np.testing.assert_allclose(lengths.std(0)[inner] / lengths.mean(0)[inner], 0, atol=0.02)
    head, foot = data.names.index("head"), data.names.index("lFoot")
    assert (data.points3d[:, head, 1] > data.points3d[:, foot, 1]).mean() > 0.95
