"""The state of objects is put back into objects that were made in the same way."""

import io
import math
import pickle
import random
import sys
import threading
from collections import OrderedDict, defaultdict, deque
from pathlib import Path, PurePosixPath

import numpy as np
import pytest
import torch as th
from gymnasium import spaces

from sb3_cchain.checkpoint.object_state import object_states, register_state, restore_objects
from sb3_cchain.checkpoint.state_pickle import NotSaved


class Thing:
    """With the attributes that it is given."""

    def __init__(self, **attributes):
        vars(self).update(attributes)


class Counter:
    """Knows its state."""

    def __init__(self, count=0):
        self.count, self.derived = count, count + 1

    def state_dict(self):
        return {"count": self.count}

    def load_state_dict(self, state):
        self.count = state["count"]
        self.derived = self.count + 1


class Foreign:
    """Passes for an object of another package."""


Foreign.__module__ = "elsewhere"


def saved(holder, known=None, skip=(), strict=False):
    """As it would be read from a file."""
    return pickle.loads(pickle.dumps(object_states({"": holder}, known, skip={"": skip}, strict=[""] if strict else [])))


def restore_object(holder, state, known=None):
    restore_objects({"": holder}, state, known)


def test_plain_data():
    values = dict(
        number=3,
        text="a",
        array=np.arange(3.0),
        tensor=th.arange(3),
        nothing=None,
        nested={"a": [1, (2, {3})]},
        queue=deque([1, 2], maxlen=2),
        default=defaultdict(list, {1: [2]}),
        ordered=OrderedDict(b=1, a=2),
    )
    thing = Thing(**{name: None for name in values}, other="stays")
    restore_object(thing, saved(Thing(**values)))
    assert thing.other == "stays"
    assert th.equal(thing.tensor, values["tensor"]) and np.array_equal(thing.array, values["array"])
    for name in values.keys() - {"tensor", "array"}:
        found = getattr(thing, name)
        assert found == values[name] and type(found) is type(values[name])
    assert thing.queue.maxlen == 2


def test_a_state_does_not_change_any_more():
    thing = Thing(array=np.zeros(2), tensor=th.zeros(2), list=[1])
    state = saved(thing)
    thing.array += 1
    thing.tensor += 1
    thing.list.append(2)
    restore_object(thing, state)
    assert thing.list == [1] and not thing.array.any() and not thing.tensor.any()


def test_objects_stay_the_objects_that_they_are():
    """So hooks and closures go on referring to them."""
    live = Thing(inner=Thing(deep=Thing(value=0)))
    inner, deep = live.inner, live.inner.deep
    restore_object(live, saved(Thing(inner=Thing(deep=Thing(value=7)))))
    assert live.inner is inner and live.inner.deep is deep and deep.value == 7


@pytest.mark.parametrize("live", [None, 3, Foreign()])
def test_an_object_that_is_not_there_is_made(live):
    thing = Thing(inner=live)
    restore_object(thing, saved(Thing(inner=Thing(value=7, deep=Thing(value=8)))))
    assert type(thing.inner) is Thing and thing.inner.value == 7 and thing.inner.deep.value == 8


def test_an_attribute_that_is_not_there_is_made():
    thing = Thing()
    restore_object(thing, saved(Thing(inner=Thing(value=7), number=3)))
    assert thing.inner.value == 7 and thing.number == 3


def test_an_object_that_became_none():
    thing = Thing(inner=Thing())
    restore_object(thing, saved(Thing(inner=None)))
    assert thing.inner is None


def test_what_two_attributes_share_is_shared_afterwards():
    array, inner = np.zeros(2), Thing(value=1)
    source = Thing(first=array, second=array, one=inner, other=inner, own=np.zeros(2))
    live = Thing(first=np.ones(2), second=np.ones(2), one=Thing(value=0), other=Thing(value=0), own=None)
    restore_object(live, saved(source))
    assert live.first is live.second and live.one is live.other and live.own is not live.first
    live.first[0] = 5
    assert live.second[0] == 5


class World:
    """Moves when it is told to."""

    def __init__(self, position):
        self.position = position


@pytest.mark.parametrize("strict", [False, True])
def test_what_a_container_and_an_attribute_share_is_shared_afterwards(strict):
    def make(value, *, attribute_first):
        world, plain, tensor = World(value), [value], th.tensor([value])
        attributes = dict(world=world, plain=plain, tensor=tensor)
        containers = dict(worlds=[world], plains={"deep": [plain]}, tensors=(tensor,), again=[[plain], world])
        return Thing(**(attributes | containers if attribute_first else containers | attributes))

    for attribute_first in (True, False):
        live = make(0, attribute_first=attribute_first)
        world = live.world
        restore_object(live, saved(make(7, attribute_first=attribute_first), strict=strict))
        assert live.world is world and live.worlds[0] is live.again[1] is world and world.position == 7
        assert live.plains["deep"][0] is live.again[0][0] is live.plain and live.plain == [7]
        assert live.tensors[0] is live.tensor and live.tensor.tolist() == [7]


@pytest.mark.parametrize("cut", [lambda grid: grid[1], lambda grid: grid[::-1, 1::2], lambda grid: grid.T])
@pytest.mark.parametrize("base", [np.zeros((3, 4)), np.zeros(12).reshape(3, 4)], ids=["own memory", "view"])
def test_a_view_of_an_array_stays_a_view(cut, base):
    def make(value):
        grid = base.copy() if base.base is None else base.base.copy().reshape(base.shape)
        grid += np.arange(12).reshape(3, 4) + value
        return Thing(part=cut(grid), grid=grid)

    source, live = make(5), make(0)
    restore_object(live, saved(source))
    assert np.array_equal(live.part, source.part) and np.array_equal(live.grid, source.grid)
    live.grid[:] = 9
    assert (live.part == 9).all() and live.part.strides == source.part.strides


def walk(thing):
    """A behaviour."""


class Animal(Thing):
    def run(self):
        pass

    def rest(self):
        pass


def test_behaviours():
    """Functions and methods by which an environment keeps what it does."""
    source, live = Animal(value=1), Animal(value=0)
    source.now, source.then, source.made = source.run, walk, lambda: 1
    live.now, live.then, live.made = live.rest, len, (made := lambda: 2)
    restore_object(live, saved(source, strict=True))
    assert live.now == live.run and live.then is walk and live.made is made


# What an environment may take from one thing to another of, such as the map of a level and its rules
NAMED = {
    "function": walk,
    "builtin function": math.sin,
    "function of PyTorch": th.sin,
    "method of a class": dict.fromkeys,
    "class": Animal,
    "path": Path("maps/b"),
    "pure path": PurePosixPath("b"),
    "none": None,
}


@pytest.mark.parametrize("name", NAMED)
def test_what_has_a_name_is_put_back_where_all_has_to_be(name):
    named = NAMED[name]
    states = saved(Thing(it=named, inner=Thing(it=named)), strict=True)
    for there in (len, World, Path("maps/a"), None):
        live = Thing(it=there, inner=Thing(it=there))
        restore_object(live, states)
        assert live.it == live.inner.it == named and type(live.it) is type(named)


def test_the_method_of_a_generator_is_that_of_the_generator_here():
    source, live = (Thing(rng=np.random.default_rng(seed)) for seed in range(2))
    source.draw, live.draw = source.rng.normal, live.rng.random
    restore_object(live, saved(source, strict=True))
    assert live.draw == live.rng.normal and live.draw() == source.draw()


def test_a_method_that_was_replaced_is_not_mistaken_for_its_replacement():
    source, live = Animal(value=1), Animal(value=0)
    for thing in (source, live):
        thing.original = thing.run
        thing.run = lambda: None
    original = live.original
    restore_object(live, saved(source, strict=True))
    assert live.original == original


@pytest.mark.parametrize("make", [lambda value: Thing(value=value), lambda value: [value]], ids=["object", "list"])
def test_what_is_shared_in_this_process_alone_is_not_shared_afterwards(make):
    live = Thing(first=make(0))
    live.second = live.first
    restore_object(live, saved(Thing(first=make(1), second=make(2))))
    first, second = (vars(it) if isinstance(it, Thing) else it for it in (live.first, live.second))
    assert first == ({"value": 1} if isinstance(first, dict) else [1]) and first != second


@pytest.mark.parametrize("make", [lambda it: [it], lambda it: {it: it}, lambda it: {it}], ids=["list", "dict", "set"])
def test_containers_stay_the_objects_that_they_are(make):
    """So somebody who was given one in this process has the right one."""
    live = Thing(inside=make(0))
    given = live.inside
    restore_object(live, saved(Thing(inside=make(1))))
    assert live.inside is given and given == make(1)


def test_what_two_holders_share_is_shared_afterwards():
    def make(value):
        shared = {"task": value}
        return {"model": Thing(state=shared), "callback": Thing(state=shared, inner=Thing(value=value))}

    states = pickle.loads(pickle.dumps(object_states(make(3))))
    live = {"model": Thing(state={}), "callback": Thing(state={}, inner=Thing(value=0))}
    restore_objects(live, states)
    assert live["model"].state is live["callback"].state and live["model"].state == {"task": 3}


def test_holders_refer_to_each_other():
    def make(value):
        model, callback = Thing(value=value), Thing(value=value)
        model.callback, callback.model = callback, model
        return {"model": model, "callback": callback}

    live = make(0)
    restore_objects(live, pickle.loads(pickle.dumps(object_states(make(3)))))
    model, callback = live["model"], live["callback"]
    assert model.callback is callback and callback.model is model and model.value == callback.value == 3


def test_cycles():
    def make(value):
        outer = Thing(value=value, inner=Thing(value=value))
        outer.inner.outer = outer
        outer.inner.itself = outer.inner
        return outer

    live = make(0)
    outer, inner = live, live.inner
    restore_object(live, saved(make(3)))
    assert live.inner is inner and inner.outer is outer and inner.itself is inner and inner.value == 3


def test_known_objects_are_those_of_this_process():
    model, other = Thing(value=1), Thing(value=2)
    state = saved(Thing(model=model, among=[model, {"it": model}]), {"model": model})
    live = Thing(model=None, among=None)
    restore_object(live, state, {"model": other})
    assert live.model is other and live.among[0] is other and live.among[1]["it"] is other and other.value == 2


@pytest.mark.parametrize(
    "make", [np.random.default_rng, np.random.RandomState, random.Random], ids=["Generator", "RandomState", "Random"]
)
def test_generators_stay_the_objects_that_they_are(make):
    source, live = Thing(rng=make(1)), Thing(rng=make(2))
    source.rng.random() if make is random.Random else source.rng.normal()
    state = saved(source)
    held = live.rng
    restore_object(live, state)
    draw = "gauss" if make is random.Random else "normal"
    assert live.rng is held and getattr(held, draw)(0, 1) == getattr(source.rng, draw)(0, 1)


def test_one_generator_of_two():
    rng = np.random.default_rng(3)
    live = Thing(first=np.random.default_rng(0), second=None)
    restore_object(live, saved(Thing(first=rng, second=rng)))
    assert live.first is live.second and live.first.normal() == rng.normal()


def test_tensors_keep_no_more_than_they_show():
    big = th.zeros(10_000)
    state = saved(Thing(view=big[:2]))
    assert len(pickle.dumps(state)) < 2000
    live = Thing(view=None)
    restore_object(live, state)
    assert live.view.tolist() == [0, 0]


def test_tensors_of_a_graph_and_their_gradients():
    leaf = th.ones(2, requires_grad=True)
    live = Thing(leaf=None, result=None)
    restore_object(live, saved(Thing(leaf=leaf, result=leaf * 2)))
    assert live.leaf.requires_grad and not live.result.requires_grad and live.result.tolist() == [2, 2]


def test_an_object_that_knows_its_state():
    live = Thing(counter=Counter(), again=None)
    counter = live.counter
    source = Counter(5)
    restore_object(live, saved(Thing(counter=source, again=source)))
    assert live.counter is counter is live.again and (counter.count, counter.derived) == (5, 6)


def test_a_holder_that_knows_its_state():
    counter = Counter()
    restore_object(counter, saved(Counter(5)))
    assert (counter.count, counter.derived) == (5, 6)


def test_modules_and_optimisers():
    def make(seed):
        th.manual_seed(seed)
        net = th.nn.Linear(2, 2)
        optimizer = th.optim.Adam(net.parameters())
        net(th.ones(1, 2)).sum().backward()
        optimizer.step()
        return Thing(net=net, optimizer=optimizer)

    source, live = make(1), make(2)
    weight = live.net.weight
    restore_object(live, saved(source, strict=True))
    assert live.net.weight is weight and th.equal(weight, source.net.weight)
    assert live.optimizer.param_groups[0]["params"][0] is weight
    assert th.equal(live.optimizer.state[weight]["exp_avg"], source.optimizer.state[source.net.weight]["exp_avg"])


@pytest.mark.parametrize("make", [Counter, lambda: th.nn.Linear(1, 1), lambda: th.optim.Adam([th.ones(1)])])
def test_an_object_with_a_state_that_has_nowhere_to_go(make):
    states = saved(Thing(made_later=make()))
    with pytest.raises(ValueError, match=r"made_later: training made this object, and .* constructor"):
        restore_object(Thing(made_later=None), states)
    restore_object(Thing(made_later=make()), states)


def test_an_object_of_this_package_that_is_not_needed():
    kind = type("ReturnsFile", (Counter,), {"__module__": "sb3_cchain.callbacks.returns_file"})
    live = Thing(file=None)
    restore_object(live, saved(Thing(file=kind())))
    assert live.file is None


class Closed:
    """Code that cannot have ``state_dict()``, and cannot be pickled."""

    def __init__(self, value):
        self.value, self.lock = value, threading.Lock()


def test_types_whose_state_is_registered():
    register_state(Closed, lambda it: it.value, lambda it, value: setattr(it, "value", value))
    live = Thing(closed=Closed(0))
    closed = live.closed
    restore_object(live, saved(Thing(closed=Closed(5)), strict=True))
    assert live.closed is closed and closed.value == 5


class Other:
    """Of another package, and no more than attributes."""

    def __init__(self, value):
        self.value = value


Other.__module__ = "some_package"


def test_of_other_packages_only_data_is_saved():
    left_out = []
    holders = {"callback": Thing(other=Other(1), inner=Thing(other=Other(1), number=1))}
    states = object_states(holders, left_out=left_out)
    assert left_out == ["callback.other", "callback.inner.other"]
    live = {"callback": Thing(other=(other := Other(0)), inner=Thing(other=Other(0), number=0))}
    restore_objects(live, states)
    assert live["callback"].other is other and other.value == 0 and live["callback"].inner.number == 1


def test_all_is_saved_where_it_has_to_be():
    live = Thing(other=Other(0))
    other = live.other
    restore_object(live, saved(Thing(other=Other(1)), strict=True))
    assert live.other is other and other.value == 1


def test_what_cannot_be_saved_is_named():
    holders = {"env": Thing(inner=Thing(lock=threading.Lock(), number=1))}
    with pytest.raises(NotSaved, match=r"^env\.inner\.lock: cannot pickle"):
        object_states(holders, strict=["env"])
    left_out = []
    states = object_states(holders, left_out=left_out)
    live = {"env": Thing(inner=Thing(lock="mine", number=0))}
    restore_objects(live, states)
    assert left_out == ["env.inner.lock"] and vars(live["env"].inner) == {"lock": "mine", "number": 1}


@pytest.mark.parametrize("strict", [False, True])
def test_what_belongs_to_the_process_stays(tmp_path, strict):
    with open(tmp_path / "closed", "w") as closed, open(tmp_path / "written", "w") as written:
        closed.close()
        attributes = dict(closed=closed, written=written, function=lambda: 1, local=type("Local", (), {}), module=sys)
        if not strict:
            attributes |= dict(path=tmp_path, kind=int, stream=io.StringIO(), named=walk)
        live = Thing(**dict.fromkeys(attributes, "mine"))
        restore_object(live, saved(Thing(**attributes), strict=strict))
        assert set(vars(live).values()) == {"mine"}


@pytest.mark.parametrize("mode", ["r", "rb", "r+"])
def test_a_file_that_is_read_cannot_be_saved(tmp_path, mode):
    (tmp_path / "numbers").write_text("1\n2\n")
    with open(tmp_path / "numbers", mode) as file, pytest.raises(NotSaved, match=r"^env\.inner\.file: cannot pickle"):
        object_states({"env": Thing(inner=Thing(file=file))}, strict=["env"])


@pytest.mark.parametrize("kind, content", [(io.StringIO, "1\n2\n"), (io.BytesIO, b"1\n2\n")])
def test_a_file_in_memory_goes_on_where_it_was(kind, content):
    live = Thing(file=kind(content))
    next(live.file)
    state = saved(live, strict=True)
    expected = next(live.file)
    restore_object(live, state)
    assert next(live.file) == expected


def test_a_path_of_this_process_stays(tmp_path):
    live = Thing(path=tmp_path)
    restore_object(live, saved(Thing(path=None)))
    assert live.path == tmp_path


def test_skipped_attributes():
    live = Thing(kept=0, skipped=0, inner=Thing(skipped=0))
    restore_object(live, saved(Thing(kept=1, skipped=1, inner=Thing(skipped=1)), skip={"skipped"}))
    assert (live.kept, live.skipped, live.inner.skipped) == (1, 0, 1)


def test_of_spaces_the_random_numbers_alone():
    source = Thing(space=spaces.Dict(a=spaces.Discrete(1000, seed=1), b=spaces.Box(-1, 1, (3,), seed=2)))
    source.space.seed(3)
    live = Thing(space=spaces.Dict(a=spaces.Discrete(1000, seed=5), b=spaces.Box(-1, 1, (3,), seed=6)))
    space = live.space
    restore_object(live, saved(source))
    assert live.space is space
    expected, found = source.space.sample(), space.sample()
    assert expected["a"] == found["a"] and np.array_equal(expected["b"], found["b"])


def test_an_object_that_appears_twice_with_its_own_state_is_restored_once():
    source, live = Counter(3), Counter()
    states = object_states({"one": Thing(it=source), "two": Thing(it=source)})
    holders = {"one": Thing(it=live), "two": Thing(it=None)}
    restore_objects(holders, states)
    assert holders["two"].it is live and live.count == 3
