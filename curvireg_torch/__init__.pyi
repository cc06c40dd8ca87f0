# ruff: noqa: I001 (one import for all modules)
from . import (
    data as data,
    errors as errors,
    evaluation as evaluation,
    filters as filters,
    geometry as geometry,
    inspection as inspection,
    mesh as mesh,
    matching as matching,
    features as features,
    pipeline as pipeline,
    registration as registration,
    rendering as rendering,
    synthetic as synthetic,
    terms as terms,
    visualization as visualization,
)
from .data import (
    BOPDataset as BOPDataset,
    Pascal3DPlus as Pascal3DPlus,
    PoseFolder as PoseFolder,
    load_camera as load_camera,
)
from .features import (
    HOG as HOG,
    field_points as field_points,
    hog as hog,
)
from .errors import (
    CurviregError as CurviregError,
)
from .filters import (
    AnisotropicDiffusion as AnisotropicDiffusion,
    ApparentRidges as ApparentRidges,
    AverageShadingGradient as AverageShadingGradient,
    DepthCurvilinearSaliency as DepthCurvilinearSaliency,
    EdgeBlur as EdgeBlur,
    HessianFrobeniusNorm as HessianFrobeniusNorm,
    ImageCurvilinearSaliency as ImageCurvilinearSaliency,
    ImageGradient as ImageGradient,
    MultiScaleCurvilinearSaliency as MultiScaleCurvilinearSaliency,
    MultiScaleFocusCurves as MultiScaleFocusCurves,
    PrincipalCurvatureImage as PrincipalCurvatureImage,
    anisotropic_diffusion as anisotropic_diffusion,
    apparent_ridges as apparent_ridges,
    average_shading_gradient as average_shading_gradient,
    depth_curvilinear_saliency as depth_curvilinear_saliency,
    edge_blur as edge_blur,
    hessian_frobenius_norm as hessian_frobenius_norm,
    image_curvilinear_saliency as image_curvilinear_saliency,
    image_gradient as image_gradient,
    multiscale_curvilinear_saliency as multiscale_curvilinear_saliency,
    multiscale_focus_curves as multiscale_focus_curves,
    principal_curvature_image as principal_curvature_image,
)
from .geometry import (
    Camera as Camera,
    PosePrior as PosePrior,
    ViewSphere as ViewSphere,
    camera_matrix as camera_matrix,
    crop_images as crop_images,
    project_points as project_points,
    rotation_error as rotation_error,
    rotation_from_viewpoint as rotation_from_viewpoint,
    sample_views as sample_views,
    uniform_views as uniform_views,
    viewpoint_from_rotation as viewpoint_from_rotation,
)
from .mesh import load_mesh as load_mesh
from .matching import (
    Ranking as Ranking,
    ViewBank as ViewBank,
    ViewMatcher as ViewMatcher,
)
from .features import (
    LearnedCurvilinearSaliency as LearnedCurvilinearSaliency,
)
from .pipeline import (
    Pipeline as Pipeline,
)
from .jobs.photograph import register as register
from .registration import (
    Registrar as Registrar,
    Registration as Registration,
)
from .rendering import (
    render_depth as render_depth,
)
from .pipeline import (
    BankSettings as BankSettings,
)
from .version import (
    __version__ as __version__,
)
from .inspection import inspect as inspect
