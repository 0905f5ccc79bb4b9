"""Hand models: tracked human skeleton, robot hand kinematics, and the 67-D action space."""

import lazy_loader

__getattr__, __dir__, __all__ = lazy_loader.attach_stub(__name__, __file__)
