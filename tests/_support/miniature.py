"""Tiny dataset trees of the real shape, with every defect that a real tree may have. Nothing here
is photographed."""

import json

import cv2
import numpy as np
import scipy.io
import trimesh

HALF = 0.25  # half the edge of the cube that all meshes are
VIEW = {"azimuth_coarse": 45.0, "elevation_coarse": 15.0, "azimuth": 30.0, "elevation": 10.0}
VIEW |= {"distance": 40.0, "focal": 1.0, "px": 41.0, "py": 31.0, "theta": -5.0}
VIEW |= {"error": np.nan, "viewport": 3000.0}
EMPTY = np.empty((0, 0))


def write_image(path, size=(60, 80), seed=0):
    """A photograph of noise, ``size`` = (H, W)."""
    path.parent.mkdir(parents=True, exist_ok=True)
    assert cv2.imwrite(
        str(path), np.random.default_rng(seed).integers(0, 256, (*size, 3), dtype=np.uint8)
    )


def write_mesh(path, half=HALF):
    """A cube about the origin, in the format of the suffix."""
    path.parent.mkdir(parents=True, exist_ok=True)
    trimesh.creation.box((2 * half,) * 3).export(path)


def pascal_object(category, **changes):
    """One entry of ``record.objects``; ``viewpoint`` is merged, other changes replace."""
    entry = {"class": category, "view": "", "truncated": 0, "occluded": 0, "difficult": 0}
    entry |= {"bbox": np.array([[11.0, 6.0, 71.0, 56.0]]), "cad_index": 1}
    entry["anchors"] = {"left_front": {"location": EMPTY, "status": 1}}
    viewpoint = changes.pop("viewpoint", {})
    entry["viewpoint"] = VIEW | viewpoint if isinstance(viewpoint, dict) else viewpoint
    return entry | changes


def _struct_array(objects):
    keys = list(dict.fromkeys(key for entry in objects for key in entry))
    array = np.empty((1, len(objects)), dtype=[(key, object) for key in keys])
    for i, entry in enumerate(objects):
        array[0, i] = tuple(entry.get(key, EMPTY) for key in keys)
    return array


def write_record(path, objects, imgsize=(80, 60, 3)):
    path.parent.mkdir(parents=True, exist_ok=True)
    record = {
        "filename": f"{path.stem}.jpg",
        "imgsize": np.array([imgsize]),
        "objects": _struct_array(objects) if objects else EMPTY,
    }
    scipy.io.savemat(path, {"record": record}, do_compression=True)


def write_pascal3d(root, part="pascal"):
    """A tree of cars and sofas in the layout of release 1.1; returns how often each reason must be
    counted."""
    annotations = root / "Annotations" / f"car_{part}"
    images = root / "Images" / f"car_{part}"
    suffix = ".jpg" if part == "pascal" else ".JPEG"
    turned = {"occluded": 1, "difficult": 1, "viewpoint": {"azimuth": 300.0, "theta": 12.0}}
    last = [
        {"viewpoint": dict.fromkeys(("azimuth", "elevation", "distance", "theta"), 0.0)},
        {"viewpoint": dict.fromkeys(("azimuth", "elevation", "distance"), EMPTY)},
        {"viewpoint": EMPTY},
        {"bbox": np.array([[20.0, 20.0, 20.0, 40.0]])},
        {"bbox": np.array([[20.0, 20.0, np.nan, 40.0]])},
        {"bbox": EMPTY},
        {"cad_index": 7},
        {"cad_index": EMPTY},
        {"bbox": np.array([[1.0, 1.0, 9.0, 5.0]])},
        {"viewpoint": {"distance": -4.0}},
    ]
    records = {
        "2008_000001": [pascal_object("car")],
        "2008_000002": [
            pascal_object("sofa"),
            pascal_object("car", truncated=1, viewpoint={"azimuth": 200.0}),
            pascal_object("car", **turned),
        ],
        "2008_000003": [pascal_object("car", **changes) for changes in last],
        "2008_000004": [],
    }
    for seed, (name, objects) in enumerate(records.items()):
        write_record(annotations / f"{name}.mat", objects)
        write_image(images / (name + suffix), seed=seed)
    # 6: without annotation
    for number in range(5, 9):
        write_image(images / f"2008_00000{number}{suffix}")
    annotations.joinpath("2008_000005.mat").write_bytes(b"MATLAB 5.0 MAT-file".ljust(200, b"\xff"))
    whole = annotations.joinpath("2008_000001.mat").read_bytes()
    annotations.joinpath("2008_000007.mat").write_bytes(whole[: len(whole) // 2])
    scipy.io.savemat(annotations / "2008_000008.mat", {"record": {"objects": "none"}})
    write_record(annotations / "2008_000009.mat", [pascal_object("car")])  # without image
    write_record(root / "Annotations" / f"sofa_{part}" / "2008_000002.mat", records["2008_000002"])
    write_image(root / "Images" / f"sofa_{part}" / ("2008_000002" + suffix), seed=1)
    for category in ("car", "sofa"):
        write_mesh(root / "CAD" / category / "01.off")
    cars = [f"2008_{i:06d}" for i in range(1, 10)]
    if part == "pascal":
        lists = root / "PASCAL" / "VOCdevkit" / "VOC2012" / "ImageSets" / "Main"
        lists.mkdir(parents=True, exist_ok=True)
        flags = [f"{name} {' 0' if name.endswith('2') else ' 1'}" for name in cars]
        lists.joinpath("car_val.txt").write_text("\n".join([*flags, "2008_000099 -1"]) + "\n")
        lists.joinpath("sofa_val.txt").write_text("2008_000001 -1\n2008_000002  1\n")
    else:
        lists = root / "Image_sets"
        lists.mkdir(parents=True, exist_ok=True)
        lists.joinpath("car_imagenet_val.txt").write_text("\n".join(cars) + "\n")
        lists.joinpath("sofa_imagenet_val.txt").write_text("2008_000002\n")
    reasons = {"other_class": 3, "coarse_viewpoint": 2, "no_viewpoint": 1, "bad_box": 3}
    reasons |= {"missing_mesh": 2, "corrupt_annotation": 4}
    return reasons | {"missing_annotation": 1, "missing_image": 1}


def write_bop(root):
    """Two scenes (rgb and grey) of cubes in the BOP layout; returns how often each reason must be
    counted."""
    R = [1.0, 0.0, 0.0, 0.0, 0.0, -1.0, 0.0, 1.0, 0.0]
    pose = {"cam_R_m2c": R, "cam_t_m2c": [1.0, 2.0, 400.0], "obj_id": 1}
    info = {"bbox_obj": [-5, 4, 30, 20], "bbox_visib": [0, 4, 25, 20]}
    info |= {"px_count_all": 500, "visib_fract": 0.8}
    K = {"cam_K": [300.0, 0.0, 40.0, 0.0, 310.0, 30.0, 0.0, 0.0, 1.0], "depth_scale": 1.0}
    hidden = {**info, "bbox_visib": [-1, -1, -1, -1], "visib_fract": 0.0}
    one = root / "test" / "000001"
    bad = [{**pose, "cam_R_m2c": [2.0] * 9}, {**pose, "cam_t_m2c": [0, 0, None]}, {"obj_id": 1}]
    bad += [{**pose, "obj_id": 8}, {**pose, "obj_id": 9}, pose, "no pose"]
    three = [pose, {**pose, "obj_id": 2}, {**pose, "cam_t_m2c": [9.0, 2.0, 400.0]}]
    ground_truth = {"0": three, "3": bad, **{key: [pose] for key in "45x"}}
    outside = {**info, "bbox_obj": [-1, -1, -1, -1]}
    infos = {"0": [info, hidden, {**info, "visib_fract": 0.9}]}
    infos |= {"3": [info] * 5 + [outside, info], "4": [info]}
    cameras = dict.fromkeys(("0", "3", "4"), K)  # 5: without camera
    for name, content in (("gt", ground_truth), ("camera", cameras), ("gt_info", infos)):
        write_json(one / f"scene_{name}.json", content)
    for key in ("0", "3", "5"):  # 4: without image
        write_image(one / "rgb" / f"{int(key):06d}.jpg", seed=int(key))
    two = root / "test" / "000002"  # grey, without scene_gt_info
    write_json(two / "scene_gt.json", {"7": [pose]})
    write_json(two / "scene_camera.json", {"7": K})
    two.joinpath("gray").mkdir()
    cv2.imwrite(str(two / "gray" / "000007.png"), np.full((60, 80), 51, dtype=np.uint8))
    damaged = root / "test" / "000003"
    damaged.mkdir()
    damaged.joinpath("scene_gt.json").write_text('{"0": [')
    root.joinpath("test", "000004").mkdir()
    for obj_id in (1, 2, 9):
        write_mesh(root / "models" / f"obj_{obj_id:06d}.ply", half=25.0)
    plain = {"diameter": 86.6}
    half_turn = [-1, 0, 0, 0, 0, -1, 0, 0, 0, 0, 1, 0, 0, 0, 0, 1]
    models = {"1": {**plain, "symmetries_discrete": [half_turn]}, "2": plain}
    write_json(root / "models" / "models_info.json", models)
    camera = {"fx": 300.0, "fy": 310.0, "cx": 40.0, "cy": 30.0, "width": 80, "height": 60}
    write_json(root / "camera.json", camera)
    places = [(1, 0), (2, 7), (1, 6)]  # the last is nowhere
    targets = [{"scene_id": s, "im_id": i, "obj_id": 1, "inst_count": 1} for s, i in places]
    write_json(root / "test_targets_bop19.json", targets)
    reasons = {"corrupt_annotation": 6, "missing_mesh": 1, "missing_model_info": 1}
    return reasons | {"bad_box": 1, "missing_image": 1, "missing_annotation": 2}


def write_web(root):
    """Two usable objects and two defective folders; returns how often each reason must be
    counted."""
    header = "image,x0,y0,x1,y1,azimuth,elevation,theta,distance\n"
    write_mesh(root / "cup" / "mesh.off")
    for i, size in enumerate([(60, 80), (50, 50)]):
        write_image(root / "cup" / f"{i}.jpg", size, seed=i)
    lines = """0.jpg,10,5,70,55,30,10,-5,3 1.jpg,10,5,40,45,,,, 1.jpg,10,5,40,45,90,0,, 2.jpg,10,5,40,45,,,,
        0.jpg,10,5,10,45,,,, 0.jpg,,,,,,,, 0.jpg,a,5,10,45,,,, 0.jpg,1,5,10,45,30,,, 0.jpg,1,5
        ../cup/0.jpg,10,5,40,45,,,, 0.jpg,1,5,inf,45,,,,"""  # noqa: E501
    table = header + "\n".join(lines.split()) + "\n"
    root.joinpath("cup", "views.csv").write_text("\ufeff" + table, encoding="utf-8")
    write_mesh(root / "shoe" / "mesh.ply")
    write_image(root / "shoe" / "a.png")
    root.joinpath("shoe", "views.csv").write_text(header + "a.png,0,0,79,59,,,,\n")
    root.joinpath("no_mesh").mkdir()
    write_mesh(root / "no_table" / "mesh.off")
    write_mesh(root / "other_table" / "mesh.off")
    root.joinpath("other_table", "views.csv").write_text("image,x,y\n")
    reasons = {"missing_image": 1, "bad_box": 2, "corrupt_annotation": 6}
    return reasons | {"missing_mesh": 1, "missing_annotation": 1}


def write_json(path, content):
    path.parent.mkdir(parents=True, exist_ok=True)
    path.write_text(json.dumps(content))
