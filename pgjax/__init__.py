"""pgjax: a differentiable Material Point Method simulator for scenes captured as Gaussians."""

__version__ = "0.1.0"
