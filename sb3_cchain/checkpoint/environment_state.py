"""Stand-in."""
from sb3_cchain.checkpoint.object_state import object_states, restore_objects
from stable_baselines3.common.monitor import Monitor
def chain(env):
    out = {}
    while True:
        out[f"l{len(out)}"] = env
        if not hasattr(env, "env"): return out
        env = env.env
def prepare_environment(env): pass
def can_save_environment(env): return True
def environment_state(env):
    lay = {}
    while hasattr(env, "venv"):
        lay[f"v{len(lay)}"] = env; env = env.venv
    s = object_states(lay, skip={"venv", "class_attributes"})
    return s, [object_states(chain(e), skip={"env"}, strict=True) for e in env.envs], env.reset_infos
def restore_environment(env, state):
    lay = {}
    while hasattr(env, "venv"):
        lay[f"v{len(lay)}"] = env; env = env.venv
    restore_objects(lay, state[0])
    for e, s in zip(env.envs, state[1], strict=True): restore_objects(chain(e), s)
    env.reset_infos = state[2]
