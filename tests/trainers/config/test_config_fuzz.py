"""Fuzzes every key of the configuration: valid values run, others give a one-line error.

Keys, types and bounds are read from the schema, so that a new key is fuzzed as well.
"""

import copy
import functools
import math
import re
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, Phase, given, settings
from hypothesis import strategies as st
from pydantic import TypeAdapter
from robustness import SOAK

from emberlink.comm.base import MODULES
from emberlink.envs.utils.config_files import known
from emberlink.envs.utils.errors import UserError
from emberlink.trainers.config.compose import from_values, resolve, to_values
from emberlink.trainers.config.schema import RunConfig
from emberlink.trainers.learners.ddpg import DDPGConfig
from emberlink.trainers.training.setup import TrainingSetup

EXAMPLES = 5000 if SOAK else 40
FUZZ = settings(
    max_examples=EXAMPLES // 2,  # half of them valid, half invalid
    deadline=None,
    derandomize=not SOAK,
    phases=[Phase.generate],  # to simplify a failing example takes a quarter of an hour
    suppress_health_check=list(HealthCheck),
    database=None,
)
# Upper limits of the tried values, where larger values would only take longer.
CAPS = {
    "env.grid": 17,
    "env.num_uavs": 4,
    "env.horizon": 12,
    "fire.num_train_fires": 2,
    "fire.fuel_patches": 2,
    "learner.hidden": 12,
    "learner.buffer_size": 400,
    "learner.batch_size": 30,
    "learner.updates_per_step": 2,
    "episodes": 3,
    "num_envs": 3,
}
FIXED = {
    "device": ["cpu"],
    "output": ["runs", "a b/c-ü"],
    "env.radio.bandwidth": [None, 0, 50],
    "env.base": [None, [0.0, 7.0], [3.5, 0.25]],
    "env.failures": [0.0, 0.5, 1.0],
    "env.sensor": [[1.0, 1.0], [0.9, 0.2]],
    "evaluation.scripted": [[], ["oracle"], ["map_greedy", "courier"]],
    "evaluation.headline": ["coverage", "fire_losses"],
    "learner.warm_start": [""],
    "policy.memory": ["none"],  # DDPG learns none
    "policy.message": ["none"],
    "policy.hold": [1],  # others must fit the horizon
}
SCHEMA = TypeAdapter(RunConfig).json_schema()
COMM = {name: TypeAdapter(MODULES.find(name).config_type).json_schema() for name in MODULES.known()}


def entered(schema: dict, root: dict) -> dict:
    """Resolves a reference to its schema; a scenario's is the generator's."""
    schema = schema.get("oneOf", [schema])[0]
    return root["$defs"][schema["$ref"].rsplit("/", 1)[-1]] if "$ref" in schema else schema


def leaves(schema: dict, root: dict, prefix: str = "") -> Iterator[tuple[str, dict]]:
    """Yields every leaf key with its schema, except `comm.*` and `learner.*`."""
    for name, below in schema["properties"].items():
        below = entered(below, root)
        if "properties" in below:
            yield from leaves(below, root, f"{prefix}{name}.")
        elif prefix + name not in ("comm", "learner"):
            yield prefix + name, below


LEARNER = TypeAdapter(DDPGConfig).json_schema()
LEARNER["properties"].pop("name")
KEYS = dict(leaves(SCHEMA, SCHEMA)) | dict(leaves(LEARNER, LEARNER, "learner."))
REACTION = dict(leaves(SCHEMA["$defs"]["ReactionConfig"], SCHEMA, "fire."))
del REACTION["fire.kind"]  # without it, the keys are the level set's
COMM_KEYS = {
    name: {
        f"comm.{key}": below for key, below in leaves({"properties": {}, **below_root}, below_root)
    }
    for name, below_root in COMM.items()
}


def bounds(schema: dict) -> tuple[float, float]:
    return (
        schema.get("minimum", schema.get("exclusiveMinimum", -math.inf)),
        schema.get("maximum", schema.get("exclusiveMaximum", math.inf)),
    )


def values_of(key: str, schema: dict) -> st.SearchStrategy:
    """Returns valid values of a key."""
    low, high = bounds(schema)
    cap = CAPS.get(key, math.inf)
    kind = schema.get("type")
    if key in FIXED:
        return st.sampled_from(FIXED[key])
    if "enum" in schema or "const" in schema:
        return st.sampled_from(schema.get("enum", [schema.get("const")]))
    if "anyOf" in schema:
        return st.one_of([values_of(key, option) for option in schema["anyOf"]])
    if kind == "null":
        return st.none()
    if kind == "boolean":
        return st.booleans()
    if kind == "integer":
        least = int(low) if math.isfinite(low) else None
        most = min(high - ("exclusiveMaximum" in schema), cap)
        return st.integers(least, int(most) if math.isfinite(most) else None)
    if kind == "number":
        return st.floats(
            None if low == -math.inf else low,
            None if high == math.inf else high,
            exclude_min="exclusiveMinimum" in schema,
            exclude_max="exclusiveMaximum" in schema,
            allow_nan=False,
            allow_infinity=False,
        )
    if kind == "string":
        return st.from_regex(re.compile(schema["pattern"], re.ASCII), fullmatch=True).map(
            lambda text: text[:100]
        )
    assert kind == "array", (key, schema)
    if "prefixItems" in schema:
        parts = [values_of(key, entered(option, SCHEMA)) for option in schema["prefixItems"]]
        pair = st.tuples(*parts)
        return pair.map(list) if key == "env.grid" else pair.map(sorted)
    least, most = schema.get("minItems", 0), min(schema.get("maxItems", 3), 3)
    items = values_of(key, entered(schema["items"], SCHEMA))
    return st.lists(items, min_size=least, max_size=most)


def invalid_values(schema: dict) -> list:
    """Returns invalid values: other types, out of bounds, of another length."""
    low, high = bounds(schema)
    kind = schema.get("type")
    other: list = [None, {}, {"a": {"b": 1}}]
    if "anyOf" in schema:
        options = [option for option in schema["anyOf"] if option.get("type") != "null"]
        nullable = len(options) < len(schema["anyOf"])
        kinds = [set(map(repr, invalid_values(option))) for option in options]
        return [
            value
            for value in invalid_values(options[0])
            if all(repr(value) in k for k in kinds) and not (nullable and value is None)
        ]
    if kind in ("integer", "number"):
        other += [True, "1", "", [1], math.nan]
        other += [low - max(1, abs(low))] if math.isfinite(low) else []
        other += [high + max(1, abs(high)), math.inf] if math.isfinite(high) else []
        other += [low] if "exclusiveMinimum" in schema else []
        other += [high] if "exclusiveMaximum" in schema else []
        return [*other, 1.5, 3.0, math.inf] if kind == "integer" else other
    if kind == "array":
        parts = schema.get("prefixItems", [schema.get("items")])
        right = [1] * len(parts)
        other += ["ab", 3, [[1], [1]], [None] * len(parts), ["x"] * len(parts)]
        other += [[*right[:-1], element] for element in ("1", math.nan, -(10**9))]
        if "prefixItems" in schema:
            return [*other, [], right[:-1], [*right, 1]]
        other += [[]] if "minItems" in schema else []
        return [*other, [1] * (schema["maxItems"] + 1)] if "maxItems" in schema else other
    if kind == "boolean":
        return [*other, 0, 1, "true", [True]]
    assert kind == "string", schema
    return [*other, 1, 1.5, True, [], ["a"], *(["", "nothing", "Raw "] if "enum" in schema else [])]


@functools.cache
def recipe(method: str, setup: str, *chosen: str) -> dict:
    return to_values(resolve(method, [f"setup={setup}", *chosen]))


def put(values: dict, key: str, value) -> dict:
    changed = copy.deepcopy(values)
    assign(changed, key, value)
    return changed


def assign(values: dict, key: str, value) -> None:
    *path, last = key.split(".")
    functools.reduce(dict.__getitem__, path, values)[last] = value


@st.composite
def valid_values(draw) -> dict:
    """Returns a recipe with a random valid value for every key."""
    method = draw(st.sampled_from(known("method")))
    values = copy.deepcopy(recipe(method, draw(st.sampled_from(known("setup"))), "learner=ddpg"))
    for key, schema in {**KEYS, **COMM_KEYS[values["comm"]["name"]]}.items():
        assign(values, key, draw(values_of(key, schema)))
    if values["comm"]["name"] == "maps":
        assign(values, "env.observation", "map")
    learner = values["learner"]
    learner["buffer_size"] = max(learner["buffer_size"], learner["batch_size"])
    return values


@pytest.mark.heavy
@settings(FUZZ, max_examples=max(15, EXAMPLES // 50))
@given(valid_values())
def test_valid_values_collect_and_learn(values):
    for name in ("episodes", "num_envs"):
        values[name] = 2
    values["env"]["horizon"] = max(values["env"]["horizon"], 3)
    TrainingSetup(from_values(values)).dry_run(steps=3)


def refused(key: str, build) -> str:
    with pytest.raises(UserError, match=re.escape(key) or ".") as caught:
        build()
    text = str(caught.value)
    assert type(caught.value) is UserError
    assert key in text, text
    assert "\n" not in text
    return text


def every_key() -> list[tuple[tuple, str, dict]]:
    """Returns the choice of a recipe that has the key, the key and its schema."""
    of_comm = {recipe(method, "paper")["comm"]["name"]: method for method in known("method")}
    rows = [(("consensus", "tuned"), key, schema) for key, schema in KEYS.items()]
    rows += [(("consensus", "tuned", "fire=reaction"), *row) for row in REACTION.items()]
    for name, several in COMM_KEYS.items():
        rows += [((of_comm[name], "tuned"), *row) for row in several.items()]
    return rows


@pytest.mark.parametrize(
    ("chosen", "key", "schema"), every_key(), ids=lambda value: str(value)[:40]
)
def test_an_invalid_value_gives_one_line_that_names_the_key(chosen, key, schema):
    values = recipe(*chosen)
    for value in invalid_values(schema):
        refused(key, lambda value=value: from_values(put(values, key, value)))
    *path, last = key.split(".")
    for other in (last + "s", last.upper(), "_target_"):
        name = ".".join([*path, other])
        refused(name, lambda name=name: from_values(put(values, name, 1)))
    without = copy.deepcopy(values)
    at = functools.reduce(dict.__getitem__, path, without)
    del at[last]
    if "default" not in schema:
        refused(key, lambda: from_values(without))
