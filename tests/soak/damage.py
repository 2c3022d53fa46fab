"""Generates damaged checkpoints and checkpoints of other configurations."""

import json
import math
import random
from collections.abc import Callable
from pathlib import Path

import torch
from safetensors.torch import load_file, save_file

from emberlink.trainers.runs import checkpoint_file


def truncated(path: Path, draw: random.Random) -> None:
    content = path.read_bytes()
    path.write_bytes(content[: draw.randrange(len(content))])


def bit_flipped(path: Path, draw: random.Random) -> None:
    """Flips one bit, in the header in half of the cases."""
    content = bytearray(path.read_bytes())
    header = 8 + int.from_bytes(content[:8], "little")
    place = draw.randrange(header if draw.random() < 0.5 else len(content))
    content[place] ^= 1 << draw.randrange(8)
    path.write_bytes(content)


def zeroed(path: Path, draw: random.Random) -> None:
    """Zeroes a block, like a block of a disk that was never written."""
    content = bytearray(path.read_bytes())
    begin = draw.randrange(len(content))
    end = min(begin + 4096, len(content))
    if not any(content[begin:end]):
        begin = 0
    content[begin:end] = bytes(end - begin)
    path.write_bytes(content)


def lengthened(path: Path, draw: random.Random) -> None:
    path.write_bytes(path.read_bytes() + draw.randbytes(draw.randint(1, 100)))


def sealed_again(path: Path, change: Callable[[dict, dict[str, torch.Tensor]], None]) -> None:
    """Changes a checkpoint and updates its checksum."""
    header, content = checkpoint_file.read(path)
    change(header, content)
    version, rest = header.pop("format"), {k: v for k, v in header.items() if k != "sha256"}
    before, checkpoint_file.FORMAT = checkpoint_file.FORMAT, version
    try:
        checkpoint_file.write(path, content, rest)
    finally:
        checkpoint_file.FORMAT = before


def of_another_method(path: Path, draw: random.Random) -> None:
    def change(header: dict, _) -> None:
        values = header if "method" in header else header["config"]
        methods = {"independent", "positional", "shared_memory", "consensus"}
        values["method"] = draw.choice(sorted(methods - {values["method"]}))

    sealed_again(path, change)


def of_another_team(path: Path, draw: random.Random) -> None:
    def change(header: dict, _) -> None:
        other = draw.randint(3, 9)
        if "uavs" in header:
            header["uavs"] = other
        else:
            header["config"]["env"]["num_uavs"] = other

    sealed_again(path, change)


def of_another_version(path: Path, draw: random.Random) -> None:
    sealed_again(path, lambda header, _: header.update(format=draw.choice((0, 2, 7, "1", None))))


def with_nan(path: Path, draw: random.Random) -> None:
    def change(_, content: dict[str, torch.Tensor]) -> None:
        names = [
            name
            for name, value in content.items()
            if value.is_floating_point()
            # The evaluated tensors in a file of networks.
            and ("/" in name or name.startswith("actor_network_params"))
        ]
        # All groups have the same probability, independent of their number of tensors.
        group = draw.choice(sorted({name.rpartition("/")[0] for name in names}))
        name = draw.choice(sorted(n for n in names if n.rpartition("/")[0] == group))
        values = content[name].view(-1)
        # A fire has infinity in cells that never burn, and NaN in its margin.
        places = values.isfinite().nonzero().flatten().tolist()
        # An arrival time of infinity is valid, too.
        bad = [math.nan] if name.endswith("_arrival_time") else [math.nan, math.inf]
        values[draw.choice(places)] = draw.choice(bad)

    sealed_again(path, change)


def without_a_tensor(path: Path, draw: random.Random) -> None:
    def change(_, content: dict[str, torch.Tensor]) -> None:
        needed = [n for n in content if "/" in n or n.startswith("actor_network_params")]
        del content[draw.choice(needed)]

    sealed_again(path, change)


def without_a_seal(path: Path, draw: random.Random) -> None:
    save_file(load_file(path), path)


def not_a_checkpoint(path: Path, draw: random.Random) -> None:
    content = json.dumps({"__metadata__": {"emberlink": draw.choice(("", "{}", "[1]", "nul"))}})
    path.write_bytes(
        draw.choice(
            (b"", draw.randbytes(50), len(content).to_bytes(8, "little") + content.encode())
        )
    )


KINDS = (
    *(truncated, bit_flipped, zeroed, lengthened, of_another_method, of_another_team),
    *(of_another_version, with_nan, without_a_tensor, without_a_seal, not_a_checkpoint),
)


def damage_trials(
    files: list[tuple[Path, Callable[[Path], object]]], count: int, seed: int
) -> tuple[int, list[str]]:
    """Damages checkpoints in turn and reads them; returns accepted files and unclear errors.

    Args:
        files: valid checkpoints and their readers.
        count: number of trials.
        seed: seed of the random numbers.
    """
    draw, failures = random.Random(seed), []
    for number in range(count):
        path, reader = files[number % len(files)]
        kind, sound = KINDS[number // len(files) % len(KINDS)], path.read_bytes()
        kind(path, draw)
        try:
            reader(path)
        except ValueError as error:
            text = str(error).replace(str(path.parent.parent), "")
            if str(path) not in str(error) or "\n" in text or len(text) > 300:
                failures.append(f"{kind.__name__}: {error}")
        else:
            failures.append(f"{kind.__name__} was accepted")
        finally:
            path.write_bytes(sound)
    return count, failures
