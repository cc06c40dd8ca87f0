"""The sentence about the mesh of the page, which is found in a thread."""

import asyncio
import time
from dataclasses import replace

import pytest
import trimesh

from curvireg_torch.errors import CurviregError
from curvireg_torch.inspection.facts import mesh_facts
from curvireg_torch.viewer import examination as module
from tests._support import refused


@pytest.fixture(autouse=True)
def _few_views(monkeypatch):
    monkeypatch.setattr("curvireg_torch.inspection.look_alikes.LOOKED_AT", 12)


def with_small_bank(workspace, folder):
    session = workspace.session
    session.options = replace(
        session.options, unit="m", pipeline=folder / "small.json", progress=False
    )


async def examined(workspace, path):
    await workspace.open_mesh(path)
    return await until_done(workspace)


async def until_done(workspace, seconds=300.0):
    deadline = time.monotonic() + seconds
    while not workspace.examination.advice and time.monotonic() < deadline:
        workspace.examination.start_if_due(searching=workspace.searching)
        await asyncio.sleep(0.02)
    return workspace.examination.advice


def test_a_sphere_is_told_without_rendering_views(workspace, tmp_path, monkeypatch):
    monkeypatch.setattr(module.Session, "open_registrar", None)
    trimesh.creation.icosphere(2, 0.1).export(tmp_path / "ball.ply")
    advice = asyncio.run(examined(workspace, tmp_path / "ball.ply"))
    assert "rotation cannot be seen" in advice


def test_another_mesh_ends_the_examination_and_is_examined_instead(workspace, scene, monkeypatch):
    faces = []

    def counted(mesh):
        faces.append(len(mesh.faces))
        if len(faces) == 1:
            time.sleep(0.3)
        return mesh_facts(mesh)

    monkeypatch.setattr(module, "mesh_facts", counted)
    with_small_bank(workspace, scene)
    trimesh.creation.icosphere(2, 0.1).export(scene / "ball.ply")

    async def use():
        await workspace.open_mesh(scene / "truck.ply")
        workspace.examination.start_if_due(searching=False)
        await asyncio.sleep(0.1)
        return await examined(workspace, scene / "ball.ply")

    assert "rotation cannot be seen" in asyncio.run(use())
    assert faces == [968, 320]


def test_a_search_ends_the_examination_which_begins_again(workspace, scene):
    examination = workspace.examination
    with_small_bank(workspace, scene)
    asyncio.run(workspace.open_mesh(scene / "truck.ply"))
    mesh = workspace.session.mesh
    key = module.registrar_key(workspace.session.request())
    examination._subject = mesh, key
    examination._report("look-alikes", 1, 48)
    examination.waits = True
    examination._report("bank", 3, 7)
    assert workspace.session.progress == ("bank", 3, 7), "the search waits for the views"
    with refused("stopped", CurviregError):
        examination._report("look-alikes", 1, 48)
    workspace.session.cancelled = True
    with refused("stopped", CurviregError):
        examination._report("bank", 4, 7)
    workspace.session.cancelled = False

    async def use():
        examination._subject = None
        examination.start_if_due(searching=True)
        assert not examination.running
        return await until_done(workspace)

    assert asyncio.run(use()) == "grey mesh: its sides differ in shape"
    assert workspace.messages == {}


def test_an_error_is_said_once_and_not_tried_again(workspace, scene, monkeypatch):
    calls = []

    def broken(mesh):
        calls.append(mesh)
        raise CurviregError("no views; simplify it")

    monkeypatch.setattr(module, "mesh_facts", broken)
    with_small_bank(workspace, scene)

    async def use():
        await examined(workspace, scene / "truck.ply")
        workspace.examination.start_if_due(searching=False)
        await asyncio.sleep(0.1)
        return workspace.examination.advice

    assert asyncio.run(use()) == "no views; simplify it"
    assert len(calls) == 1
