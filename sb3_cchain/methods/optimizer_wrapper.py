"""An optimiser that wraps another one."""

import inspect
from collections.abc import Callable, Iterator
from types import NoneType
from typing import Any, ClassVar

import torch as th
from torch.optim.optimizer import ParamsT


class OptimizerWrapper(th.optim.Optimizer):
    """
    An optimiser that adds something to the steps, or to the gradients, of another one, the base. In everything else it behaves
    as the base: they share the parameter groups and the state, so the learning rate schedules of SB3 and torch, and code that
    reads ``optimizer.state[parameter]``, find what they expect.

    What a wrapper itself has to remember is kept in the same state under its ``name``, so it is saved and loaded with it. It
    is made when first needed: a checkpoint of the base alone can be loaded, and the wrapper then starts from the parameters in
    it, as it does after ``optimizer.state.clear()``.

    Wrappers nest, and the outermost acts last::

        TRAC(parameters, lr=1e-3, base_class=WeightClipping, base_kwargs=dict(clip_ratio=1.0, base_kwargs=dict(eps=1e-5)))

    Hooks that are registered with one of the nested optimisers run once, at its own step. Hooks for all optimisers
    (``register_optimizer_step_pre_hook``) run for each of them.

    :param params: Parameters or parameter groups
    :param lr: Learning rate of the base
    :param base_class: Class of the optimiser inside, which may be another wrapper. It must not need a closure, as LBFGS does.
    :param base_kwargs: Its keyword arguments, learning rate excluded. SB3 gives ``eps=1e-5`` to a plain Adam in actor-critic
        policies, but to no other class. To get the same here, set ``base_kwargs=dict(eps=1e-5)``.
    :raises TypeError: When ``base_class`` is not an optimiser class, or needs a closure, and for arguments that it does not
        have
    :raises ValueError: When a wrapper is nested in another one of its kind
    """

    # Key in the state, and prefix in the log. Each kind has its own
    name: ClassVar[str] = "optimizer_wrapper"
    # Whether there are `base_class` and `base_kwargs`
    has_arguments_of_base: ClassVar[bool] = True

    def __init__(
        self,
        params: ParamsT,
        lr: float | th.Tensor = 1e-3,
        *,
        base_class: type[th.optim.Optimizer] = th.optim.Adam,
        base_kwargs: dict[str, Any] | None = None,
        **unknown: Any,
    ):
        if unknown:
            raise TypeError(
                f"{type(self).__name__} has no argument {', '.join(unknown)}. Give those of the optimiser inside as "
                "`base_kwargs=dict(...)`."
            )
        if not (isinstance(base_class, type) and issubclass(base_class, th.optim.Optimizer)):
            raise TypeError(f"`base_class` must be a class of optimisers, got {base_class!r}")
        if inspect.signature(base_class.step).parameters["closure"].default is inspect.Parameter.empty:
            raise TypeError(
                f"`base_class` must not need a closure, which Stable-Baselines3 does not give, got {base_class.__name__}"
            )
        if not isinstance(base_kwargs, (dict, NoneType)):
            raise TypeError(f"`base_kwargs` must be a dictionary, got {base_kwargs!r}")
        self.base: th.optim.Optimizer = base_class(params, lr=lr, **(base_kwargs or {}))  # type: ignore[call-arg]
        if any(wrapper.name == self.name for wrapper in nested_wrappers(self.base)):
            raise ValueError(
                f"`base_class` must not contain another {type(self).__name__}, got {base_class.__name__}. (They are told "
                f"apart by `name`, here {self.name!r}: give each class of your own another one.)"
            )
        # As `Optimizer.__init__`, which would also make new parameter groups and a new state
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
        """What the wrapper remembers, by name. Replace the values, never change them in place: a saved state shares them."""
        return self.state[self.name]  # an empty one at first: torch's state is a defaultdict

    def parameters(self) -> list[th.Tensor]:
        """
        :return: All parameters, in order
        """
        return [parameter for group in self.param_groups for parameter in group["params"]]

    def weights(self, n_output_layers: int = 0) -> list[th.Tensor]:
        """
        :param n_output_layers: Number of weights at the end that are left out
        :return: The parameters that are weight matrices, or of convolutions, in order
        """
        weights = [parameter for parameter in self.parameters() if parameter.dim() > 1]
        return weights[: max(len(weights) - n_output_layers, 0)]

    def matrices(self) -> list[th.Tensor]:
        """
        :return: The parameters that it treats as weight matrices; none if it treats all parameters alike
        """
        return []

    def reference(self) -> list[th.Tensor]:
        """
        :return: A copy of each parameter, made when this was first called, or first called with that parameter. SB3 makes
            optimisers before it moves a policy to its device, and before some policies initialise their weights, so the first
            call must come in training.
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
        :param closure: Computes the loss and its gradients. It is called once, before everything else.
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
        A subclass extends this method. (It must not extend ``step()``: torch wraps that in the hooks, and ``super().step()``
        could run them again.)
        """
        self.base.step()

    def add_param_group(self, param_group: dict[str, Any]) -> None:
        """
        :param param_group: As for any optimiser
        """
        self.base.add_param_group(param_group)

    def metrics(self) -> dict[str, float]:
        """
        :return: Its metrics and those of the wrappers inside, by name, for :class:`~sb3_cchain.methods.OptimizerMetrics`
        """
        return self.base.metrics() if isinstance(self.base, OptimizerWrapper) else {}

    def load_state_dict(self, state_dict: dict[str, Any]) -> None:
        """
        :param state_dict: As for any optimiser
        """
        self.base.load_state_dict(state_dict)  # which may take other state than torch's optimisers
        self._unshare()

    def _unshare(self) -> None:
        self.state[self.name] = dict(self.own_state)  # a copy, because the owner of the saved state goes on changing it

    def __getstate__(self) -> dict[str, Any]:
        # As torch's: without hooks, and without methods that were replaced on the instance
        return {name: value for name, value in vars(self).items() if not (name.startswith("_optimizer") or callable(value))}

    def __setstate__(self, state: dict[str, Any]) -> None:
        # Called by `copy` and `pickle` with new groups and state
        base_state = {name: value for name, value in state.items() if name in ("param_groups", "state")}
        super().__setstate__({name: value for name, value in state.items() if name not in base_state})
        if base_state:
            self.base.__setstate__(base_state)
            self._unshare()


def nested_wrappers(optimizer: th.optim.Optimizer) -> Iterator[OptimizerWrapper]:
    """
    :param optimizer: An optimiser
    :return: It and those inside of it, from the outside to the inside, as far as they are wrappers
    """
    while isinstance(optimizer, OptimizerWrapper):
        yield optimizer
        optimizer = optimizer.base
