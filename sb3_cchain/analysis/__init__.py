"""Measures to see a loss of plasticity and forgetting by: churn, the NTK, the health of networks, returns on all tasks."""

from sb3_cchain.analysis.churn_monitor import ChurnMonitor
from sb3_cchain.analysis.doctor import Doctor
from sb3_cchain.analysis.eval_all_tasks import EvalAllTasks
from sb3_cchain.analysis.eval_trained_task import EvalTrainedTask
from sb3_cchain.analysis.network_health import NetworkHealth
from sb3_cchain.analysis.ntk_callback import NTKCallback

__all__ = ["ChurnMonitor", "Doctor", "EvalAllTasks", "EvalTrainedTask", "NTKCallback", "NetworkHealth"]
