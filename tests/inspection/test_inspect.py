"""What is said of a mesh before a photograph is taken."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch
import trimesh

import curvireg_torch as cr
from curvireg_torch.inspection import photographs
from curvireg_torch.inspection.facts import mesh_facts
from curvireg_torch.inspection.look_alikes import (
    LookAlike,
    confused_sides,
    look_alikes,
    print_difference,
)
from curvireg_torch.inspection.page import report_lines, report_page
from curvireg_torch.inspection.photographs import (
    SIZE,
    GeneratedPhotograph,
    PhotographGenerator,
    photographed_mesh,
    trial_camera,
    with_print,
)
from curvireg_torch.inspection.report import Inspection
from curvireg_torch.inspection.surface import look_symmetries
from curvireg_torch.inspection.trial import Expected, Outcome, Trial, run_trial
from curvireg_torch.mesh.mesh import as_mesh
from curvireg_torch.registration import Registrar
from curvireg_torch.synthetic import example_mesh
from tests._support import bank_around, bank_of, double, eye, refused, slow_after, unrefined
from tests._support.spies import spied

HALF_TURN = torch.diag(double([-1.0, -1.0, 1.0]))
UPSIDE_DOWN = torch.diag(double([1.0, -1.0, -1.0]))
VIEW = cr.rotation_from_viewpoint(20.0, 30.0, 0.0).double()


def plate(size, at):
    return trimesh.creation.box(size).apply_translation(at)


def two_coloured(mesh, is_red):
    """The mesh, with red and blue faces."""
    mesh.visual.face_colors = np.where(is_red, (200, 30, 30, 255), (30, 30, 200, 255))
    return mesh


def check_warned(facts, *texts):
    for text in texts:
        assert any(text in warning for warning in facts.warnings)


def half_solid_box():
    """A box of 60 x 40 x 30 without a bottom, of which one half is solid: only from below is its
    sides' difference seen."""
    walls = [plate((60, 2, 30), (0, y, 0)) for y in (19, -19)]
    walls += [plate((2, 40, 30), (x, 0, 0)) for x in (29, -29)]
    half = plate((30, 40, 30), (15, 0, 0))
    return trimesh.util.concatenate([plate((60, 40, 2), (0, 0, 14)), *walls, half])


@pytest.fixture(scope="module")
def inspected(small_bank):
    """The report of a registrar, and its progress."""
    registrar = Registrar(small_bank, pipeline=unrefined(small_bank), mesh_is="exact")
    calls = []
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)
        report = cr.inspect(
            registrar, n=1, compare=False, progress=lambda *progress: calls.append(progress)
        )
    return report, calls


def test_facts_of_a_closed_body_and_of_its_triangles_apart():
    box = trimesh.creation.box((0.1, 0.2, 0.3))
    faces = np.arange(36).reshape(-1, 3)
    apart = trimesh.Trimesh(box.triangles.reshape(-1, 3), faces, process=False)
    for mesh in (box, apart):
        mesh.units = "m"
        facts = mesh_facts(mesh)
        assert facts.is_watertight
        assert (facts.faces, facts.parts, facts.doubled_faces) == (12, 1, 0)
        assert facts.area_of_hull == pytest.approx(1.0)
        assert len(facts.symmetries) == 3
        assert max(symmetry.deviation_percent for symmetry in facts.symmetries) < 0.2
        assert not facts.is_hopeless
        check_warned(facts, "4 orientations")


def test_open_doubled_and_loose_faces_are_counted():
    box = trimesh.creation.box((1, 2, 3))
    faces = np.concatenate([box.faces[:-1], box.faces[:3]])
    twice = trimesh.Trimesh(box.vertices, faces, process=False)
    other = plate((0.2, 0.2, 0.2), (3, 0, 0))
    facts = mesh_facts(trimesh.util.concatenate([twice, other]))
    assert (facts.parts, facts.doubled_faces) == (2, 3)
    assert not facts.is_watertight
    check_warned(facts, "3 faces exist twice")


@pytest.mark.parametrize(
    ("size", "unit", "text"),
    [
        (80.0, None, "suggests mm (0.11 m) or cm (1.1 m); give the unit"),
        (
            80.0,
            "m",
            "106 m across: is its unit really m; usual would be mm (0.11 m) or cm (1.1 m)?",
        ),
        (0.3, "mm", "really mm; usual would be m (0.4 m)?"),
        (1000.0, "m", "1,319 m across"),
        (0.3, "m", None),
        (80.0, "dm", None),
    ],
)
def test_unit_is_doubted_by_size(size, unit, text):
    mesh = trimesh.creation.box((size, 0.7 * size, 0.5 * size))
    if unit:
        mesh.units = unit
    warnings = [warning for warning in mesh_facts(mesh).warnings if "unit" in warning]
    assert (text is None) == (not warnings)
    assert text is None or text in warnings[0]


def test_flat_meshes_have_a_flat_hull():
    """One triangle ended in an error of Qhull."""
    triangle = [[0, 0, 0], [100, 0, 0], [0, 80, 0]]
    square = [[0, 0, 1], [3, 4, 1], [-1, 7, 1], [-4, 3, 1]]
    both_sides = [[0, 1, 2], [0, 2, 3], [0, 2, 1], [0, 3, 2]]
    for corners, faces, area in ((triangle, [[0, 1, 2]], 0.5), (square, both_sides, 1.0)):
        facts = mesh_facts(trimesh.Trimesh(corners, faces, process=False))
        assert facts.area_of_hull == pytest.approx(area)


def test_a_sphere_and_a_wire_are_hopeless():
    rods = [plate((1, 0.001, 0.001), (0.5, 0, 0)), plate((0.001, 1, 0.001), (0, 0.5, 0))]
    wire = trimesh.util.concatenate([*rods, plate((0.001, 0.001, 1), (0, 0, 0.5))])
    for mesh, text in (
        (trimesh.creation.icosphere(2), "rotation cannot be seen"),
        (wire, "wire"),
    ):
        facts = mesh_facts(mesh)
        assert facts.is_hopeless
        check_warned(facts, text)


def test_a_room_is_hopeless_and_a_large_object_is_not():
    box = trimesh.creation.box((5.0, 4.0, 2.6))
    room = trimesh.util.concatenate(
        [trimesh.Trimesh(box.vertices, box.faces[:, ::-1]), plate((1.8, 0.9, 0.7), (0, 0, -0.9))]
    )
    room.units = box.units = "m"
    facts = mesh_facts(room)
    assert facts.is_hopeless
    assert "as a room's do" in facts.warnings[-1]
    assert not mesh_facts(box).is_hopeless
    small = room.copy()
    small.units = "cm"
    assert not mesh_facts(small).is_hopeless, "a box that is inside out"


def test_thin_parts_and_flipped_faces_are_told():
    body = trimesh.creation.box((1, 2, 3))
    assert mesh_facts(body).thin == 0.0
    assert mesh_facts(example_mesh()).thin == 0.0, "its parts reach into one another"
    sheet = plate((3.0, 3.0, 0.01), (0, 0, 2))
    facts = mesh_facts(trimesh.util.concatenate([trimesh.creation.box((0.5, 0.5, 0.5)), sheet]))
    assert 0.8 < facts.thin < 1.0
    check_warned(facts, "thinner than 1 %")
    assert facts.has_consistent_faces
    faces = body.faces.copy()
    faces[0] = faces[0, ::-1]
    flipped = mesh_facts(trimesh.Trimesh(body.vertices, faces, process=False))
    assert not flipped.has_consistent_faces
    check_warned(flipped, "flipped")


def test_symmetry_deviation_grows_with_the_asymmetry():
    most = []
    for side in (0.1, 0.2):
        parts = [trimesh.creation.box((1, 2, 3)), plate((side,) * 3, (0, 0.9, 1.5))]
        facts = mesh_facts(trimesh.util.concatenate(parts))
        most.append(max(symmetry.deviation_percent for symmetry in facts.symmetries))
    assert most[1] > most[0]


@pytest.mark.slow
def test_a_half_hollow_box_looks_alike_from_above_and_not_from_below():
    registrar = Registrar(bank_of(half_solid_box()), mesh_is="exact")
    assert registrar.symmetries_of(exact=True) is None
    pairs = look_alikes(registrar)
    elevation = cr.viewpoint_from_rotation(torch.stack([pair.rotation for pair in pairs]))[1]
    alike = torch.tensor([pair.is_alike for pair in pairs])
    angle = torch.tensor([pair.angle for pair in pairs])
    assert alike[elevation > 30].all()
    assert not alike[elevation < -40].any()
    assert (angle[elevation > 30] > 170).all(), "half a turn away"


def test_look_alikes_leave_out_symmetries(monkeypatch):
    monkeypatch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)
    bank = bank_around(trimesh.creation.box((1, 2, 3)), 60, [-45, 0, 45], image_size=64)
    counted, left_out = (
        look_alikes(Registrar(bank, mesh_is="exact", symmetries=symmetries))
        for symmetries in (eye(4)[None], None)
    )
    assert np.mean([pair.is_alike for pair in counted]) > 0.8
    assert np.mean([pair.is_alike for pair in left_out]) < 0.3
    assert min(pair.angle for pair in left_out) > 30.0


@pytest.mark.parametrize("clutter", slow_after(1, [False, True]))
def test_photographs_depend_on_seed_and_number_alone(clutter):
    first, again, other = (
        PhotographGenerator(example_mesh(), seed, clutter=clutter) for seed in (5, 5, 10**15)
    )
    first(0)
    one = first(1)
    same = again(1)
    assert torch.equal(one.image, same.image)
    assert torch.equal(one.truth, same.truth)
    assert not torch.equal(one.truth, other(1).truth)


@pytest.fixture
def undrawn(monkeypatch):
    """Photographs are black."""
    drawn = torch.zeros(3, *SIZE), torch.zeros(4)
    monkeypatch.setattr(photographs, "synthesize_photograph", lambda *_, **__: drawn)


@pytest.mark.usefixtures("undrawn")
def test_upright_photographs_are_seen_from_the_side():
    generate = PhotographGenerator(example_mesh(), 0, upright=True)
    for number in range(6):
        elevation = cr.viewpoint_from_rotation(generate(number).truth[:3, :3])[1]
        assert -25.0 < elevation < 75.0


@pytest.mark.usefixtures("undrawn")
def test_clutter_differs_from_photograph_to_photograph(monkeypatch):
    drawn = spied(monkeypatch, photographs, "_random_object")
    generate = PhotographGenerator(trimesh.creation.box((1, 2, 3)), 0, clutter=True)
    first = []
    for number in (0, 1):
        drawn.clear()
        generate(number)
        first.append(drawn[0][0])
    assert first[0] != first[1]


@pytest.mark.slow
def test_clutter_is_seen_beside_the_object_and_covers_less_than_half_of_it():
    mesh = trimesh.creation.box((1, 2, 3))
    grey = torch.full((3, *SIZE), 0.5)
    plain = PhotographGenerator(mesh, 3, backgrounds=[grey])
    cluttered = replace(plain, clutter=True)
    changed, covered = [], []
    for index in range(4):
        without, photograph = plain(index), cluttered(index)
        assert torch.equal(photograph.truth, without.truth)
        assert torch.equal(photograph.box, without.box)
        seen = cr.render_depth(mesh, photograph.truth, trial_camera(), SIZE)[0, 0] > 0
        change = (photograph.image.float() - without.image.float()).abs().amax(dim=0) > 20
        changed.append(float(change[~seen].double().mean()))
        covered.append(float(change[seen].double().mean()))
    assert min(changed) > 0.002
    assert max(covered) < 0.5
    assert 0 < sum(fraction > 0.05 for fraction in covered) < 4, "in some photographs"


def test_a_print_varies_over_the_surface_and_leaves_the_shape():
    mesh = trimesh.creation.cylinder(1.0, 3.0)
    mesh.units = "cm"
    printed = with_print(mesh)
    assert printed.has_colours
    assert printed.unit == "cm"
    assert printed.bounds == pytest.approx(mesh.bounds)


def test_ranges_take_their_last_border_in():
    trial = Trial(tuple(outcome(1.0, elevation=e) for e in (-90.0, 0.0, 45.0, 90.0)), {})
    found = trial.by(lambda each: each.elevation, (-90.0, 0.0, 90.0))
    assert {name: expected.n for name, expected in found.items()} == {"-90 to 0": 1, "0 to 90": 3}
    assert list(trial.by(lambda each: each.elevation, (0.0, math.inf))) == ["0 or more"]


@pytest.mark.parametrize("is_coloured", [False, True])
def test_photographs_of_many_faces_show_a_simplified_mesh(monkeypatch, is_coloured):
    fine = trimesh.creation.icosphere(5, 2.0)
    if is_coloured:
        two_coloured(fine, fine.triangles_center[:, :1] > 0.0)
    fine.units = "cm"
    fine = replace(as_mesh(fine), up="y")
    assert photographed_mesh(fine) is fine
    for name, value in (("MANY_FACES", 9_000), ("COLOURED_FACES", 2_000)):
        monkeypatch.setattr(photographs, name, value)
    simple = photographed_mesh(fine)
    assert len(simple.faces) <= (2_000 if is_coloured else 8_000)
    assert simple.bounds == pytest.approx(fine.bounds, abs=0.05)
    assert simple.has_colours == is_coloured
    assert (simple.unit, simple.up) == ("cm", "y")
    if is_coloured:
        reds = simple.colours.corners[..., 0] > 125
        sides = simple.vertices[simple.faces][..., 0]
        assert (reds == (sides > 0.0))[np.abs(sides) > 0.1].all()


def test_trial_counts_right_and_reliable_and_stages_are_reported_in_order(inspected):
    report, calls = inspected
    assert report.trial.expected.n == 1
    assert not report.trial.compared
    stages = ["mesh", "look-alikes", "photographs"]  # the bank is there
    assert list(dict.fromkeys(stage for stage, _, _ in calls)) == stages
    for stage in stages:
        done = [(done, total) for name, done, total in calls if name == stage]
        assert done == sorted(done)
        assert done[0][0] == 0
        assert done[-1][0] == done[-1][1]


def outcome(error, *, elevation=0.0):
    picture = torch.zeros(3, 4, 4, dtype=torch.uint8)
    box = torch.tensor([0.0, 0, 200, 100])
    photograph = GeneratedPhotograph(picture, box, eye(4), trial_camera())
    return Outcome(photograph, None, error, elevation)


def test_expected_shares():
    expected = Expected.of([outcome(error) for error in (1.0, 4.0, 20.0, 170.0)])
    assert (expected.n, expected.right, expected.within_5_deg) == (4, 0.75, 0.5)
    assert (expected.reliable, expected.reliable_and_wrong) == (0.0, 0.0)
    assert expected.median_deg == 4.0


@pytest.mark.parametrize(
    ("name", "value"),
    [
        ("n", -1),
        ("seed", 1.5),
        ("device", "nowhere"),
        ("photograph", torch.zeros(4, 9, 9)),
        ("pixels outside", np.full((9, 9, 3), 255.0)),
    ],
)
def test_what_photographs_cannot_be_generated_with_is_refused_first(name, value, monkeypatch):
    monkeypatch.setattr("curvireg_torch.inspection.report.mesh_facts", None)
    option = {name: value} if isinstance(value, float | int | str) else {"backgrounds": [value]}
    with refused(name, cr.CurviregError):
        cr.inspect(trimesh.creation.box((1, 2, 3)), **option)


def test_settings_beside_a_registrar_are_refused(small_bank):
    for option in ({"pipeline": cr.Pipeline()}, {"renderer": "embree"}):
        with refused("pipeline, renderer"):
            cr.inspect(Registrar(small_bank), **option)


def test_page_groups_symmetries_by_their_turn():
    can = mesh_facts(trimesh.creation.cylinder(0.3, 1.0, sections=72))
    assert not can.is_hopeless
    page = report_page(Inspection(can), title="can")
    assert page.count("<tr><td>180°</td><td>37</td>") == 1
    assert page.count("<tr><td>10°</td><td>2</td>") == 1
    assert "in 1 part, closed" in page


def test_page_escapes_names(inspected):
    report, _ = inspected
    assert "<b>" not in report_page(report, title="<b>x").replace("<body>", "")
    assert any(line.startswith("size:") for line in report_lines(report))


@pytest.mark.slow
def test_symmetries_of_colours_are_told_from_those_of_shape():
    bands = trimesh.creation.cylinder(0.3, 1.0, sections=24).subdivide().subdivide()
    height = bands.triangles_center[:, 2]
    two_coloured(bands, height[:, None] > 0.2)
    assert len(look_symmetries(bands)) == 36, "no half turn upside down"
    facts = mesh_facts(bands)
    assert facts.is_coloured
    check_warned(facts, "body of revolution")
    label = bands.copy()
    beside = (bands.triangles_center[:, 0] > 0.2) & (np.abs(height) < 0.1)
    label.visual.face_colors = np.where(beside[:, None], (250,) * 4, bands.visual.face_colors)
    assert len(look_symmetries(label)) == 1
    assert len(mesh_facts(label).symmetries) == 71


def pair_of(rival, **more):
    return LookAlike(VIEW, rival, 180.0, 0.9, 0.8, **more)


def test_sides_that_are_confused_are_named():
    around = pair_of(VIEW @ HALF_TURN)
    over = pair_of(VIEW @ UPSIDE_DOWN)
    quarter = pair_of(cr.rotation_from_viewpoint(110.0, 30.0, 0.0).double())
    for pairs, up, sides in (
        ([around, around, over], "z", "front and back"),
        ([around, over, over], "z", "top and bottom"),
        ([around], "y", "top and bottom"),
        ([quarter], "z", "several sides"),
    ):
        assert confused_sides(pairs, up) == sides


def test_one_sentence_says_what_looks_alike_and_what_helps():
    facts = mesh_facts(example_mesh())
    alike = pair_of(VIEW @ HALF_TURN, hint="--azimuth")
    other = LookAlike(VIEW, VIEW @ HALF_TURN, 180.0, 0.2, 0.8)
    brief = Inspection(facts, (alike, alike, alike, *[other] * 7)).in_brief
    remedy = "give a texture or a pose prior (--azimuth)"
    assert brief == f"grey mesh: front and back look alike from 30 % of the views; {remedy}"
    assert Inspection(facts, (other,)).in_brief == "grey mesh: its sides differ in shape"
    told = replace(alike, print_differs=0.5)
    painted = mesh_facts(example_mesh(painted=True))
    brief = Inspection(painted, (told, told, other)).in_brief
    assert brief.endswith("look alike in shape from 67 % of the views; its print tells them apart")
    brief = Inspection(painted, (told, alike)).in_brief
    assert "its print tells 50 % of these apart, a pose prior (--azimuth) the others" in brief


def test_a_print_tells_sides_of_a_box_apart_and_a_plain_one_does_not():
    box = trimesh.creation.box((1, 2, 3)).subdivide().subdivide()
    middles = box.triangles_center
    views = cr.sample_views(azimuth_step=180, elevations=[0])
    view = cr.rotation_from_viewpoint(60.0, 20.0, 0.0).double()
    front = middles[:, :1] > 0
    ends = np.abs(middles[:, 2:]) > 1
    for is_red, least, most in ((front, 0.5, 1.0), (ends, 0.0, 0.01)):
        bank = bank_of(two_coloured(box, is_red), views)
        describer = Registrar(bank, mesh_is="exact").describer
        distance = bank.distances.median().double().cpu()
        assert least <= print_difference(describer, view, view @ HALF_TURN, distance) <= most


@pytest.mark.slow
def test_a_printed_can_is_predicted_better_with_its_texture_than_without():
    printed = with_print(trimesh.creation.cylinder(0.033, 0.12))
    views = cr.sample_views(azimuth_step=30, elevations=[-60, -30, 0, 30, 60])
    generate = PhotographGenerator(printed, 2, upright=True)
    right = []
    for mesh in (printed, replace(printed, colours=None)):
        registrar = Registrar(bank_of(mesh, views), mesh_is="exact", symmetries=eye(4)[None])
        right.append(run_trial(registrar, generate, 6, compare=False).expected.right)
    with_texture, grey = right
    assert with_texture > grey + 0.3
