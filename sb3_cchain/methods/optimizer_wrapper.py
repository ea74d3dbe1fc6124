"""An optimiser around another one."""

import inspect
from collections.abc import Callable
from types import NoneType
from typing import Any, ClassVar

import torch as th
from torch.optim.optimizer import ParamsT


class OptimizerWrapper(th.optim.Optimizer):
    """
    An optimiser that adds something to the steps, or to the gradients, of another one. It is that one in all else: the
    parameter groups and the state are the base's own, so SB3's learning rate schedules, torch's, and whoever looks into
    ``optimizer.state[parameter]`` find what they expect.

    What a wrapper itself has to remember stands in the same state under its ``name``, hence is saved and loaded with it. It
    is made when first needed: a checkpoint of the base alone can be loaded, and the wrapper starts anew from its parameters,
    as it does after ``optimizer.state.clear()``.

    Wrappers nest, and the outermost acts last::

        TRAC(parameters, lr=1e-3, base_class=WeightClipping, base_kwargs=dict(clip_ratio=1.0, base_kwargs=dict(eps=1e-5)))

    Hooks that are registered with one of the nested optimisers run once, at its own step. Each of them being an optimiser,
    hooks for all optimisers (``register_optimizer_step_pre_hook``) run for each.

    :param params: Parameters or parameter groups
    :param lr: Learning rate of the base
    :param base_class: Class of the optimiser inside, which may be another wrapper. It must not need a closure (as LBFGS does).
    :param base_kwargs: Its keyword arguments, learning rate excluded. SB3 gives ``eps=1e-5`` to a plain Adam in actor-critic
        policies, but to no other class: for the same, set ``base_kwargs=dict(eps=1e-5)``.
    :raises TypeError: When ``base_class`` is no optimiser class, or one that needs a closure
    :raises ValueError: When a wrapper is nested in another one of its kind
    """

    # Key of the state, prefix of the log
    name: ClassVar[str]

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        base_class: type[th.optim.Optimizer] = th.optim.Adam,
        base_kwargs: dict[str, Any] | None = None,
    ):
        if not (isinstance(base_class, type) and issubclass(base_class, th.optim.Optimizer)):
            raise TypeError(f"`base_class` must be a class of optimisers, got {base_class!r}")
        if inspect.signature(base_class.step).parameters["closure"].default is inspect.Parameter.empty:
            raise TypeError(
                f"`base_class` must not need a closure, which Stable-Baselines3 does not give, got {base_class.__name__}"
            )
        if not isinstance(base_kwargs, (dict, NoneType)):
            raise TypeError(f"`base_kwargs` must be a dictionary, got {base_kwargs!r}")
        self.base: th.optim.Optimizer = base_class(params, lr=lr, **(base_kwargs or {}))  # type: ignore[call-arg]
        inner = self.base
        while isinstance(inner, OptimizerWrapper):
            if inner.name == self.name:
                raise ValueError(f"`base_class` must not contain another {type(self).__name__}, got {base_class.__name__}")
            inner = inner.base
        # As `Optimizer.__init__`, less the parameter groups and the state of its own that it would make
        self.__setstate__({})

    @property
    def param_groups(self) -> list[dict[str, Any]]:  # type: ignore[override]
        """The base's."""
        return self.base.param_groups

    @property
    def state(self) -> dict[Any, Any]:  # type: ignore[override]
        """The base's, with what the wrapper remembers under its name."""
        return self.base.state

    @property
    def defaults(self) -> dict[str, Any]:  # type: ignore[override]
        """The base's."""
        return self.base.defaults

    @property
    def own_state(self) -> dict[str, Any]:
        """What the wrapper remembers, by name. Replace the values, don't change them: a saved state shares them."""
        return self.state[self.name]  # an empty one at first: torch's state is a defaultdict

    def parameters(self) -> list[th.Tensor]:
        """
        :return: All parameters, in order
        """
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def reference(self) -> list[th.Tensor]:
        """
        :return: A copy of each parameter, from when this was first called (or first with that parameter). Optimisers are made
            before SB3 moves a policy to its device, and before some policies initialise their weights: the first call must
            come in training.
        """
        parameters = self.parameters()
        known = self.own_state.get("reference", [])
        new = [parameter.detach().clone() for parameter in parameters[len(known) :]]
        reference = [copy.to(parameter.device) for copy, parameter in zip([*known, *new], parameters, strict=True)]
        self.own_state["reference"] = reference
        return reference

    def zero_grad(self, set_to_none: bool = True) -> None:
        """
        :param set_to_none: As for any optimiser
        """
        self.base.zero_grad(set_to_none)

    def step(self, closure: Callable[[], Any] | None = None) -> Any:
        """
        :param closure: Computes the loss and its gradients. It is called once, before all else.
        :return: Its loss
        """
        loss = None
        if closure is not None:
            with th.enable_grad():
                loss = closure()
        with th.no_grad():
            self._step()
        return loss

    def _step(self) -> None:
        """
        What a subclass changes. (Not ``step()``, which torch wraps in the hooks: ``super().step()`` could run them again.)
        """
        self.base.step()

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """
        :param param_group: As for any optimiser
        """
        self.base.add_param_group(param_group)

    def metrics(self) -> dict[str, float]:
        """
        :return: What it did and what the wrappers inside did, by name, for :class:`~sb3_cchain.methods.OptimizerMetrics`
        """
        return self.base.metrics() if isinstance(self.base, OptimizerWrapper) else {}

    def __getstate__(self) -> dict[str, Any]:
        # As torch's, without hooks, and without methods that were replaced on the instance
        return {name: value for name, value in vars(self).items() if not (name.startswith("_optimizer") or callable(value))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Called by `copy`, `pickle`, and by `load_state_dict` with new groups and state
        of_base = {name: value for name, value in state.items() if name in ("param_groups", "state")}
        super().__setstate__({name: value for name, value in state.items() if name not in of_base})
        if of_base:
            self.base.__setstate__(of_base)
            self.state[self.name] = dict(self.own_state)  # the saved state's owner goes on with its own
