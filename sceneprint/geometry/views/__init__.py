"""Views of an imported surface, as a sensor inside it would observe them.

surface, parameters  --choose_views-->  ViewPlan, poses (V, 4, 4)
Renderer(surface, parameters).view(pose)  -->  depth (H, W), or points (K, 3)
"""

from sceneprint.geometry.views.parameters import ViewParameters, view_parameters
from sceneprint.geometry.views.plan import ViewPlan, choose_views
from sceneprint.geometry.views.render import Renderer

__all__ = ["Renderer", "ViewParameters", "ViewPlan", "choose_views", "view_parameters"]
