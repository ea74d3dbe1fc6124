"""SB3's own training loops with a few lines replaced: an independent implementation to test against."""

import inspect
import sys
import textwrap

# So that a loop over minibatches knows those to come
NUMBERED_MINIBATCHES = (
    "for rollout_data in self.rollout_buffer.get(self.batch_size):",
    "minibatches = list(self.rollout_buffer.get(self.batch_size))\nfor position, rollout_data in enumerate(minibatches):",
)

# For the comparisons with PPO's rewritten loop, and the coefficient of the churn loss
PPO_SETTINGS = dict(
    n_steps=64,
    batch_size=16,
    n_epochs=4,
    learning_rate=3e-3,
    ent_coef=0.01,
    policy_kwargs=dict(net_arch=[16]),
    seed=0,
    device="cpu",
)
COEF = 30.0


def rewritten(method, *replacements):
    """``method`` with each original replaced, all lines at its indentation; fails when SB3 has changed an original."""
    source = textwrap.dedent(inspect.getsource(method))
    for original, replacement in replacements:
        assert source.count(original) == 1, f"SB3 changed `{original}`"
        line = next(line for line in source.splitlines() if original in line)
        indent = line[: len(line) - len(line.lstrip())]
        source = source.replace(original, replacement.replace("\n", f"\n{indent}"))
    namespace = dict(vars(sys.modules[method.__module__]))
    exec(source, namespace)
    return namespace[method.__name__]
