"""Folders of the user: viewpoints, where they are known."""

from ..data import PoseFolder
from ..jobs.store import Row, Rows
from .benchmark import VIEWPOINT_COLUMNS, Benchmark, Errors


class PoseFolderBenchmark(Benchmark):
    """Viewpoints in folders of the user. The method is given the box and the object's mesh, and no
    camera.

    Photographs of unknown pose are registered too. They count in ``n``, ``reliable`` and
    ``mean_confidence``, None without calibrated confidences; accuracy and errors are those of the
    ``n_posed`` others.
    """

    name = "web"
    label = "{category}/{object_index}"
    columns = (
        "category",
        "object_index",
        "image_id",
        *VIEWPOINT_COLUMNS,
        "score",
        "confidence",
        "reliable",
        "failed",
        "seconds",
    )
    dataset: PoseFolder

    def scores(self, rows: Rows, errors: Errors, chosen: list[int]) -> Row:
        """Accuracy at 15 and 30 degrees and the median error where the pose is known; confidence of
        all."""
        posed = errors["error_deg"][chosen]
        posed = posed[~posed.isnan()]
        scores = (
            self.rotation_scores(posed)
            if len(posed)
            else dict.fromkeys((*self.thresholds, "med_err_deg"))
        )
        # 0 without a pose; None of a pipeline whose confidence is not calibrated
        confidences = [rows[i].get("confidence", 0.0) for i in chosen]
        is_calibrated = bool(chosen) and None not in confidences
        return {
            **scores,
            "n": len(chosen),
            "n_posed": len(posed),
            "reliable": sum(bool(rows[i].get("reliable")) for i in chosen),
            "mean_confidence": sum(confidences) / len(chosen) if is_calibrated else None,
        }
