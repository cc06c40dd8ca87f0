"""ViewMatcher and Registrar as PyTorch users expect: autocast, devices, dtypes, copies, hooks."""

import copy
import pickle
import warnings
from dataclasses import replace

import pytest
import torch
from torch import nn
from torch.testing import assert_close

from curvireg_torch import Registrar, ViewMatcher, terms
from curvireg_torch.features import LearnedCurvilinearSaliency
from curvireg_torch.filters import ImageGradient
from curvireg_torch.registration import Follower, detect, refine
from curvireg_torch.terms import QueryFeatures
from curvireg_torch.visualization import registration_sheet
from tests._support import CAMERA, answer_to, eye, refused, scene, sequence, truck_bank


@pytest.fixture(scope="module")
def matcher(small_bank):
    return ViewMatcher(small_bank)


def scores(matcher):
    image, box, _ = scene(0)
    return matcher(image[None], box[None]).scores


@pytest.mark.parametrize("whitening", ["none", "bank"])
def test_matcher_computes_in_full_precision_under_autocast(small_bank, whitening):
    pipeline = small_bank.pipeline.with_term("hog", whitening=whitening)
    matcher = ViewMatcher(small_bank, pipeline=pipeline)
    image, box, _ = scene(0)
    query = matcher.query(image[None], box[None])
    expected = scores(matcher)
    similarity = matcher.similarity(query)
    with torch.autocast("cpu", dtype=torch.bfloat16):
        for one in (matcher, ViewMatcher(small_bank, pipeline=pipeline)):
            assert torch.equal(scores(one), expected)
        assert torch.equal(matcher.similarity(query), similarity)
        assert matcher.features(query.crops).descriptors.dtype == torch.float32


def _boxed(registrar):
    return answer_to(0, registrar).transform


def _detected(registrar):
    return detect(registrar, [scene(0)[0]], CAMERA)[0][0].transform


def _refined(registrar):
    image, _, T = scene(0)
    return refine(registrar, [image], CAMERA, T[None])[0].transform


def _together(registrar):
    image, box, _ = scene(0)
    cameras = eye(4).repeat(2, 1, 1)
    return registrar.register_views([image, image], box.expand(2, 4), CAMERA, cameras).transform


def _drawn(registrar):
    image, box, _ = scene(0)
    return torch.from_numpy(registration_sheet(registrar, answer_to(0, registrar), image, box))


def _followed(registrar):
    frames = sequence(2)
    follow = Follower(registrar, CAMERA)
    follow.start(frames[0][0], frames[0][2])
    return follow(frames[1][0]).transform


@pytest.mark.slow
@pytest.mark.parametrize("register", [_boxed, _drawn, _followed, _detected, _refined, _together])
def test_registrar_computes_in_full_precision_under_autocast(small_bank, register):
    detection = replace(small_bank.pipeline.detection, proposals=1)
    pipeline = replace(small_bank.pipeline, detection=detection)
    expected = register(Registrar(small_bank, pipeline=pipeline))
    with torch.autocast("cpu", dtype=torch.bfloat16):
        assert torch.equal(register(Registrar(small_bank, pipeline=pipeline)), expected)


@pytest.mark.parametrize("convert", ["half", "bfloat16", "double"])
def test_matcher_refuses_other_dtypes_and_stays_as_it_was(matcher, convert):
    before = scores(matcher)
    with refused("ViewMatcher: computes in float32, got torch"):
        getattr(matcher, convert)()
    with refused("float32"):
        torch.nn.Sequential(matcher).to(getattr(torch, convert, torch.float64))
    assert matcher.float() is matcher
    assert torch.equal(scores(matcher), before)


def test_matcher_moves_bank_terms_and_networks(small_bank):
    """The meta device needs no GPU. It has no values to dilate points with."""
    pipeline = small_bank.pipeline.with_term("repeatability", weight=0)
    matcher = ViewMatcher(small_bank, pipeline=pipeline)
    scores(matcher)
    before = matcher.describer
    moved = torch.nn.Sequential(matcher).to("meta")[0]
    assert moved is matcher
    assert {x.device.type for x in matcher.bank.tensors.values()} == {"meta"}
    assert small_bank.device.type == "cpu", "the caller's bank is not changed"
    assert {p.device.type for p in matcher.parameters()} == {"meta"}
    assert matcher.describer is not before
    empty = torch.zeros(1, 1, small_bank.descriptors.shape[1], device="meta")
    query = QueryFeatures(empty, empty, empty, empty, torch.zeros(1, device="meta"))
    for _, compare in matcher._terms:
        assert compare(query).device.type == "meta"


def test_matcher_keeps_its_terms_where_it_already_is(matcher):
    compared = matcher._terms
    assert matcher.to("cpu")._terms is compared


COPIES = copy.deepcopy, lambda matcher: pickle.loads(pickle.dumps(matcher))


@pytest.mark.cuda
def test_matcher_on_a_gpu_and_back(small_bank):
    """There it refuses half precision, ignores autocast, and its copies stay."""
    matcher = ViewMatcher(small_bank)
    expected = scores(matcher)
    found = scores(matcher.to("cuda"))
    assert found.is_cuda
    assert_close(found.cpu(), expected, atol=0.02, rtol=0.0)
    with refused("float32"):
        matcher.half()
    with torch.autocast("cuda", dtype=torch.float16):
        assert_close(scores(matcher), found, atol=1e-4, rtol=0.0)
    for copied in COPIES:
        other = copied(matcher)
        assert other.bank.device.type == "cuda"
        assert_close(scores(other), found, atol=1e-4, rtol=0.0)
    assert_close(scores(matcher.to("cpu")), expected, atol=1e-3, rtol=0.0)


@pytest.mark.parametrize("copied", COPIES)
def test_matcher_can_be_copied_and_pickled(small_bank, copied):
    matcher = ViewMatcher(small_bank)
    expected = scores(matcher)
    _ = matcher.describer  # renderers cannot be pickled
    other = copied(matcher)
    assert torch.equal(scores(other), expected)
    other.bank.descriptors.zero_()
    assert torch.equal(scores(matcher), expected), "a bank of its own"
    assert str(other.pipeline) == str(matcher.pipeline)
    _ = other.describer


def test_hooks_change_the_field_and_leave_its_mask(small_bank):
    field = LearnedCurvilinearSaliency()
    matcher = ViewMatcher(small_bank, field=field)
    image, box, _ = scene(0)
    plain = matcher.query(image[None], box[None])
    handle = field.register_forward_hook(lambda *arguments: 2.0 * arguments[-1])
    hooked = matcher.query(image[None], box[None])
    assert_close(hooked.field, 2.0 * plain.field)
    assert plain.mask is not None
    assert_close(hooked.mask, plain.mask)
    handle.remove()
    assert torch.equal(matcher.query(image[None], box[None]).field, plain.field)


KINDS = "forward_pre_hook forward_hook full_backward_hook full_backward_pre_hook"
OF_ALL_MODULES = "module_forward_hook module_forward_pre_hook"


@pytest.mark.parametrize("kind", [*KINDS.split(), *OF_ALL_MODULES.split()])
def test_a_hook_of_any_kind_calls_the_field(kind):
    field = LearnedCurvilinearSaliency()
    seen = []
    owner = nn.modules.module if kind.startswith("module") else field
    handle = getattr(owner, f"register_{kind}")(lambda module, *_: seen.append(module))
    crops = torch.rand(1, 3, 32, 32, requires_grad=True)
    terms.photograph_field(field, crops)[0].sum().backward()
    handle.remove()
    assert seen.count(field) == 1


def test_only_fields_of_the_caller_record_gradients(small_bank, matcher):
    assert not scores(matcher).requires_grad
    assert scores(ViewMatcher(small_bank, field=LearnedCurvilinearSaliency())).requires_grad


def test_gradients_reach_the_photograph_without_a_warning():
    image, box, _ = scene(0)
    image = image.clone().requires_grad_()
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        ViewMatcher(truck_bank())([image], box[None]).scores.sum().backward()
    assert float(image.grad.abs().amax()) > 0.0


def test_a_custom_field_is_a_module_that_keeps_the_size():
    with refused(r"field: expected a module such as ImageGradient\(\), got <class"):
        ViewMatcher(truck_bank(), field=ImageGradient)
    crops = torch.rand(3, 1, 32, 32)
    for wrong in (nn.Conv2d(1, 2, 3), nn.Conv2d(1, 1, 1)):
        with refused(r"field: expected shape \(3, 2, 32, 32\), got"):
            terms.photograph_field(wrong, crops)
