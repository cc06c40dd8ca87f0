"""Networks: the learned curvilinear saliency field and the ImageNet backbone of the appearance term."""

from .learned_field import FieldNetwork, LearnedCurvilinearSaliency, doubled_angle, halved_angle

__all__ = ["FieldNetwork", "LearnedCurvilinearSaliency", "doubled_angle", "halved_angle"]
