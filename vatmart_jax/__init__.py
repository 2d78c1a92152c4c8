"""VAT-Mart in MuJoCo/MJX, JAX and Flax: actionable visual priors for 3D articulated objects."""

__version__ = "0.1.0"
