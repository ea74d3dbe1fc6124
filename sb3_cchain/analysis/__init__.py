"""Measures to see a loss of plasticity by: churn, the neural tangent kernel, the health of networks."""

from sb3_cchain.analysis.churn_monitor import ChurnMonitor
from sb3_cchain.analysis.network_health import NetworkHealth
from sb3_cchain.analysis.ntk_callback import NTKCallback

__all__ = ["ChurnMonitor", "NTKCallback", "NetworkHealth"]
