"""Float32 products with oneDNN: used in updates only, and only where nothing is rounded."""

import pytest
import torch

from emberlink.trainers.config.compose import resolve
from emberlink.trainers.rollout import products
from emberlink.trainers.rollout.products import fast_products, is_float32
from emberlink.trainers.training.setup import TrainingSetup

SETTINGS = torch.backends.mkldnn.matmul


def factors():
    return torch.randn(2, 256, 256, generator=torch.Generator().manual_seed(1))


@pytest.fixture
def rounding(monkeypatch):
    """A processor on which oneDNN rounds to bfloat16."""
    monkeypatch.setattr(products, "_stays_float32", lambda: False)


def test_rounded_products_are_recognised():
    a, b = factors()
    assert is_float32(a @ b, a, b)
    assert not is_float32((a.bfloat16() @ b.bfloat16()).float(), a, b)
    assert not is_float32(a.bfloat16().float() @ b.bfloat16().float(), a, b)


def test_products_in_the_block_are_float32():
    a, b = factors()
    with fast_products():
        product = a @ b
    assert is_float32(product, a, b)


def test_the_setting_is_restored():
    before = SETTINGS.fp32_precision
    with fast_products():
        assert SETTINGS.fp32_precision == ("bf16" if products._stays_float32() else before)
    assert SETTINGS.fp32_precision == before
    with pytest.raises(RuntimeError, match="in the block"), fast_products():
        raise RuntimeError("in the block")
    assert SETTINGS.fp32_precision == before


def test_nothing_changes_where_products_are_rounded(rounding):
    before = SETTINGS.fp32_precision
    with fast_products():
        assert SETTINGS.fp32_precision == before


def test_only_the_learner_computes_in_the_block(monkeypatch):
    monkeypatch.setattr(products, "_stays_float32", lambda: True)
    setup = TrainingSetup(resolve("independent", ["env.horizon=20", "episodes=1"]))
    before, seen = SETTINGS.fp32_precision, []
    learner, collector = setup.learner, iter(setup.collector)
    monkeypatch.setattr(learner, "learn", lambda _: seen.append(SETTINGS.fp32_precision) or [])
    rollout = next(collector)
    assert SETTINGS.fp32_precision == before
    setup.learn(rollout)
    assert seen == ["bf16"]
    assert SETTINGS.fp32_precision == before
