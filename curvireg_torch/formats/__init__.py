"""Files of other tools, read into plain values: cameras, boxes, poses, masks, meshes; and what
other tools read. No torch is imported.

Results are numbers, lists and numpy arrays; :mod:`curvireg_torch.data` and
:mod:`curvireg_torch.mesh` make the library's own types of them. docs/formats.md lists every format.
"""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
