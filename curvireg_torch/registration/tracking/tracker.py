"""The pose in the next frame, from three kinds of measurement: tracked points, colours beside the outline, edges."""

import math
import os
from collections.abc import Mapping
from dataclasses import dataclass, replace

import torch
import torch.nn.functional as F
from torch import Tensor

from ...geometry.cameras import projected_boxes
from ...rendering import DepthRenderer
from ..contours.descent import ContourProblem, ContourState, project
from ..contours.points import EdgeField
from .flow import Flow, Keyframe, flow_equations, flow_weights, make_keyframe, pose_from_flow, track_points
from .regions import Lines, RegionModel, colour_bins, line_posterior
from .window import SIZE, Window, cut_window

__all__ = ["TRACKING_FEATURES", "TrackedPose", "Tracker"]

TRACKING_FEATURES = ("edge_support", "region", "flow", "agreement")


def P(name, default):
    return type(default)(os.environ.get(name, default)) if not isinstance(default, tuple) else tuple(
        float(x) for x in os.environ[name].split(",")) if name in os.environ else default


REACHES = P("REACHES", (10.0, 6.0, 4.0, 2.5))
W_EDGE, W_REGION, W_FLOW, W_KEY = P("W_EDGE", 1.0), P("W_REGION", 1.0), P("W_FLOW", 0.3), P("W_KEY", 0.5)
RATE, TEMPER = P("RATE", 0.2), P("TEMPER", 0.3)
KEY_ANGLE = P("KEY_ANGLE", 8.0)


@dataclass(frozen=True)
class TrackedPose:
    T: Tensor
    features: Mapping[str, float]


class Tracker:
    def __init__(self, renderer: DepthRenderer, hull: Tensor, centre: Tensor, radius: float) -> None:
        self.renderer, self.hull, self.centre, self.radius = renderer, hull.double(), centre.double(), radius
        self.last: Keyframe | None = None
        self.poses: list[Tensor] = []
        self.keyframes: list[Keyframe] = []

    def start(self, image: Tensor, K: Tensor, T: Tensor) -> None:
        T = T.double()[None]
        self.regions = RegionModel(RATE, TEMPER)
        self.keyframes, self.poses = [], [T]
        window = self._window(image, T, K)
        problem = self._problem(window)
        depth = self.renderer.render(T, window.K, (SIZE, SIZE)).cpu()
        self._learn(window, problem.state(T), depth, T, 1.0)
        self._remember(window, T, depth)

    def predictions(self) -> list[Tensor]:
        last = self.poses[-1]
        if len(self.poses) < 2:
            return [last]
        before = self.poses[-2]
        # the centre moves on, and the object turns on
        R = last[:, :3, :3] @ before[:, :3, :3].mT @ last[:, :3, :3]
        c0, c1 = (T[:, :3, :3] @ self.centre + T[:, :3, 3] for T in (before, last))
        out = last.clone()
        out[:, :3, :3] = R
        out[:, :3, 3] = 2 * c1 - c0 - R @ self.centre
        return [out, last]

    def track(self, image: Tensor, K: Tensor) -> TrackedPose:
        best = None
        for T in self.predictions():
            window = self._window(image, T, K)
            flow = track_points(self.last, window, T, self.centre)
            T = pose_from_flow(flow, T, window.K, self.centre) if flow.uv.shape[1] >= 8 else T
            res = flow.uv - project(flow.model, T, window.K, self.centre)[0]
            n = float(flow_weights(res, 3.0).sum()) / max(len(self.last.uv), 1)
            if best is None or n > best[0] + 0.1:
                best = (n, T, window, flow)
            if n > 0.5:
                break
        share, T, window, flow = best
        # a window around the pose
        new = self._window(image, T, K)
        A = new.K[0] @ torch.linalg.inv(window.K[0])
        flow = Flow(flow.model, flow.uv * A.diagonal()[:2] + A[:2, 2])
        window = new
        key = self._nearest(T)
        keyflow = track_points(key, window, T, self.centre, levels=1)
        problem = self._problem(window)
        bins = colour_bins(window.colours)
        state = problem.state(T)
        depth = self.renderer.render(state.rendered, window.K, (SIZE, SIZE)).cpu()
        for reach in REACHES:
            for _ in range(2):
                lines, index = self._lines(state, T, window, depth)
                A, b = (W_FLOW * x for x in flow_equations(flow, T, window.K, self.centre, 2.0))
                A2, b2 = (W_KEY * x for x in flow_equations(keyflow, T, window.K, self.centre, 2.0))
                A3, b3 = self._region_equations(lines, index, state, T, window, bins, int(reach))
                others = (A + A2 + W_REGION * A3, b + b2 + W_REGION * b3)
                others = tuple(x / W_EDGE for x in others)
                T = problem.step(state.points, T, reach, others)
            rendered = state.rendered
            state = problem.rendered_again(replace(state, T=T))
            if state.rendered is not rendered:
                depth = self.renderer.render(state.rendered, window.K, (SIZE, SIZE)).cpu()
        U, _, V = torch.linalg.svd(T[:, :3, :3])
        T = T.clone()
        T[:, :3, :3] = U @ V
        # features
        lines, index = self._lines(state, T, window, depth)
        mean, var = self._posteriors(lines, T, window, bins, 8)
        good = torch.exp(-0.5 * (mean / 2.0) ** 2) * (1 - var / (64 / 3)).clamp(min=0)
        res = keyflow.uv - project(keyflow.model, T, window.K, self.centre)[0]
        res0 = flow.uv - project(flow.model, T, window.K, self.centre)[0]
        features = {
            "edge_support": float(problem.edge_support(state)),
            "region": float(good.mean()) if len(good) else 0.0,
            "flow": float(flow_weights(res0, 2.0).sum()) / max(len(self.last.uv), 1),
            "agreement": float(flow_weights(res, 2.0).sum()) / max(len(key.uv), 1),
            "n_flow": len(self.last.uv), "n_key": len(key.uv),
        }
        self._T, self._update = T, (window, state, depth)
        return TrackedPose(T[0], features)

    def accept(self) -> None:
        window, state, depth = self._update
        self.poses = [self.poses[-1], self._T]
        self._learn(window, state, depth, self._T, RATE)
        self._remember(window, self._T, depth)

    def _nearest(self, T: Tensor) -> Keyframe:
        R = torch.cat([k.T[:, :3, :3] for k in self.keyframes])
        cos = 0.5 * ((R * T[:, :3, :3]).sum(dim=(1, 2)) - 1)
        return self.keyframes[int(cos.argmax())]

    def _remember(self, window: Window, T: Tensor, depth: Tensor) -> None:
        self.last = make_keyframe(window, T, depth)
        if self.keyframes:
            R = self._nearest(T).T[:, :3, :3]
            cos = 0.5 * (float((R * T[:, :3, :3]).sum()) - 1)
            if cos > math.cos(math.radians(KEY_ANGLE)):
                return
        self.keyframes = [*self.keyframes[-29:], self.last]

    def _window(self, image: Tensor, T: Tensor, K: Tensor) -> Window:
        return cut_window(image, projected_boxes(self.hull, T, K[None])[0], K)

    def _problem(self, window: Window) -> ContourProblem:
        zero = torch.zeros(1, dtype=torch.long)
        return ContourProblem(self.renderer, EdgeField(window.colours), zero, window.K, SIZE, self.centre, self.radius)

    def _lines(self, state: ContourState, T: Tensor, window: Window, depth: Tensor) -> tuple[Lines, Tensor]:
        """Lines across the silhouette, at T, and the indices of their points. depth is that of state.rendered."""
        points = state.points
        n_occ = points.model.shape[1]
        uv0, _ = project(points.model, state.rendered, window.K, self.centre)
        n = points.normals
        mask = depth[0, 0] > 0

        def at(x):
            x = x[0].round().long().clamp(0, SIZE - 1)
            return mask[x[:, 1], x[:, 0]]

        plus, minus = at(uv0 + 2.5 * n), at(uv0 - 2.5 * n)
        keep = (plus ^ minus) & points.valid[0]
        keep[256:] = False
        index = keep.nonzero()[:, 0]
        sign = torch.where(plus, -1.0, 1.0).double()[index, None]
        uv, _ = project(points.model[:, index], T, window.K, self.centre)
        return Lines(uv[0], sign * n[0, index]), index

    def _sectors(self, lines: Lines, T: Tensor, window: Window) -> Tensor:
        c, _ = project(self.centre[None, None], T, window.K, self.centre)
        d = lines.uv - c[0]
        return torch.atan2(d[:, 1], d[:, 0])

    def _posteriors(self, lines: Lines, T: Tensor, window: Window, bins: Tensor, reach: int) -> tuple[Tensor, Tensor]:
        offsets = torch.arange(-reach, reach + 1, dtype=torch.float64)
        ratio = self.regions.log_ratio(bins, lines.samples(offsets), self._sectors(lines, T, window))
        return tuple(x.double() for x in line_posterior(ratio, reach))

    def _region_equations(self, lines, index, state, T, window, bins, reach):
        mean, var = self._posteriors(lines, T, window, bins, reach)
        info = (1.0 / (var + 0.5) - 3.0 / reach**2).clamp(min=0.0)
        # posterior mean is shrunk: undo
        _, du = project(state.points.model[:, index], T, window.K, self.centre)
        J = (lines.normals[:, None] @ du[0])[:, 0]
        WJ = info[:, None] * J
        return (WJ.mT @ J)[None], (WJ.mT @ mean)[None]

    def _learn(self, window: Window, state: ContourState, depth: Tensor, T: Tensor, rate: float) -> None:
        lines, _ = self._lines(state, T, window, depth)
        bins = colour_bins(window.colours)
        offsets = torch.cat([torch.arange(-24.0, -1.0), torch.arange(2.0, 25.0)]).double()
        samples = lines.samples(offsets)
        x, y = samples.round().long().clamp(0, SIZE - 1).unbind(-1)
        inside = depth[0, 0][y, x] > 0
        sectors = self._sectors(lines, T, window)[:, None].expand(inside.shape)
        valid = torch.ones_like(inside)
        self.regions.learn(bins, samples.flatten(0, 1), sectors.flatten(), inside.flatten(), valid.flatten(), rate)
