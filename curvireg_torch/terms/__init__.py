"""Ranking terms: scores of views for photographs, and what photographs are described by."""

from .terms import TERMS as TERMS
from .terms import Appearance as Appearance
from .terms import BoxShape as BoxShape
from .terms import Correlation as Correlation
from .terms import QueryFeatures as QueryFeatures
from .terms import Repeatability as Repeatability
from .terms import Term as Term
from .terms import Views as Views
from .terms import Whitening as Whitening
from .terms import box_shapes as box_shapes
from .terms import crop_regions as crop_regions
from .terms import jittered_boxes as jittered_boxes
from .terms import ledoit_wolf as ledoit_wolf
from .terms import photograph_field as photograph_field
from .terms import whole_box_shapes as whole_box_shapes
