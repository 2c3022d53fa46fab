"""Passes on what radios know, one link a step, within a limit of bytes and with a delay."""

import torch
from torch import Tensor, nn

from emberlink.envs.config import RadioConfig
from emberlink.envs.world.coverage_map import View, mark, own_maps
from emberlink.envs.world.knowledge import Knowledge
from emberlink.envs.world.radio import Late

OLD = 100
"""largest gain of an entry for one hearer, steps"""
CONTACT = 10
"""steps after its last message for which a radio counts as in range"""
ACKNOWLEDGEMENT = 2
"""bytes of the number of a radio whose message was received"""
_LACKING, _OPEN = 1, 2
"""states of entries, see `Exchange.pending`"""
_NOTHING = -2
"""the code of an entry that nobody has seen"""
_NEVER = -CONTACT
"""the step of a message that never came"""


class Exchange(nn.Module):
    """Lets radios say the entries of their maps that others lack.

    A radio says an entry if a radio in range has no look at it, has an older one, or does not know
    that it was seen while it burned. It passes on received entries from the next step on.

    An entry that it has heard is left to the speaker, unless it is in contact with a radio whose
    messages the speaker is not known to have acknowledged lately: else each radio of a clique would
    tell all others what one has told. An entry that a speaker says in the last `CONTACT` steps
    before it leaves or fails may never reach the others.

    A radio knows others from their messages alone: who was in range lately, which entries a radio
    has said, and which messages it has acknowledged. An acknowledgement is part of the next
    message, so that an entry is said again `2 delay + 2` steps later if none has come.

    Within a limit of bytes, the entries of the highest gain are said: the steps by which the looks
    of the radios in range get newer, at most `OLD` each.

    An entry is coded as twice its number in the map, plus whether it was seen while it burned.

    Args:
        config: the radio.
        sizes: int64 [items], the bytes of each entry of a map.
        shape: environments and radios.
        unit: numbers in a map per step, a power of 2.
        header: bytes that a radio says in each step, 2 of them its number.
    """

    pending: Tensor
    """int8 [envs, r, items]: 0 for entries that all radios in range have, `_OPEN` for entries that
    are to be judged at the next step, `_LACKING` for entries that a radio in range lacks"""
    rank: Tensor
    """int32 [envs, r, items]: higher for entries to be said earlier within a limit, 0 for others"""
    contact: Tensor
    """bool [envs, r, r]: the radios (column) that were in range of a radio at the last step"""
    has: Tensor
    """int32 [envs, r, items, r]: codes that a radio (second) knows another one (last) to have"""
    told: Tensor
    """int32 [envs, r, items]: codes last said"""
    told_at: Tensor
    """int32 [envs, r, items]: the steps at which they were said, -1 for never"""
    heard: Tensor
    """int32 [envs, r, r]: step of the last message that a radio (row) received"""
    got: Tensor
    """bool [envs, r, r]: the messages that a radio (row) received at the last step"""
    reached: Tensor
    """int32 [envs, r, r, r]: step at which a radio (second) last heard another one (third)
    acknowledge a message of one (last)"""
    codes: Tensor
    """int32 [envs, delay + 1, r, items]: the codes of the entries said at a step"""
    said_at: Tensor
    """int32 like `codes`: the steps, -1 for never"""
    acknowledged: Tensor
    """bool [envs, r, r]: the messages of a radio (row) that others acknowledged at the last step"""
    sizes: Tensor
    _first: Tensor

    def __init__(
        self,
        config: RadioConfig,
        sizes: Tensor,
        shape: tuple[int, int],
        *,
        unit: int = 1,
        header: int = 2,
    ):
        super().__init__()
        self.config, self.bits, self.header = config, unit.bit_length(), header
        self.wait, items = 2 * config.delay + 2, len(sizes)
        (envs, radios), self.shape = shape, (*shape, items)
        self.smallest = int(sizes.min())
        self.larger = int((sizes > self.smallest).sum())
        self.register_buffer("sizes", sizes, persistent=False)
        self.register_buffer("_first", own_maps(*self.shape), persistent=False)
        self.register_buffer("pending", torch.zeros(self.shape, dtype=torch.int8))
        self.register_buffer("rank", torch.zeros(self.shape, dtype=torch.int32))
        pairs = envs, radios, radios
        for name in ("contact", "got", "acknowledged"):
            self.register_buffer(name, torch.zeros(pairs, dtype=torch.bool))
        never = torch.tensor(_NEVER, dtype=torch.int32)
        self.register_buffer("heard", never.repeat(pairs))
        self.register_buffer("reached", never.repeat(*pairs, radios))
        self.register_buffer("told_at", torch.full(self.shape, -1, dtype=torch.int32))
        nothing = torch.tensor(_NOTHING, dtype=torch.int32)
        self.register_buffer("told", nothing.repeat(self.shape))
        self.register_buffer("has", nothing.repeat(*self.shape, radios))
        self.register_buffer("codes", nothing.repeat(envs, config.delay + 1, radios, items))
        self.register_buffer("said_at", torch.full_like(self.codes, -1))
        no = torch.tensor(False)
        self.links = Late(config.delay, no, envs, 2, radios, radios)

    def start_episodes(self, mask: Tensor) -> None:
        """Forgets everything in the environments of a mask, bool [envs]."""
        blank = dict.fromkeys(("pending", "rank", "contact", "got", "acknowledged"), 0)
        blank |= dict.fromkeys(("told_at", "said_at"), -1)
        blank |= dict.fromkeys(("told", "has"), _NOTHING)
        blank |= dict.fromkeys(("heard", "reached"), _NEVER)
        self.links.start_episodes(mask)
        for name, value in blank.items():
            getattr(self, name)[mask] = value

    @property
    def waits(self) -> Tensor:
        """The bytes of the entries that did not fit at the last step, int64 [envs, r]."""
        return ((self.rank > 0) * self.sizes).sum(-1) * self.contact.any(-1)

    def saw(self, view: View) -> None:
        """Notes the cells that UAVs see at this step."""
        index = view.cells + self._first[:, : view.cells.shape[1]]
        self._reopen(index.view(-1), view.in_view.view(-1))

    def _reopen(self, entry: Tensor, where: Tensor) -> None:
        """Opens entries where a bool tensor is true."""
        self.pending.view(-1).scatter_reduce_(0, entry, _OPEN * where.char(), "amax")

    def forward(
        self, known: Knowledge, hears: Tensor, step: Tensor, left: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Speaks and listens for a step; updates the maps of the hearers.

        Args:
            known: the maps of all radios.
            hears: bool [envs, r, r], the radios (column) in range of a radio whose messages of this
                step are not lost.
            step: int64 [envs], steps since the episode began.
            left: int64 [envs, r], the bytes that each radio can say; None for no limit.

        Returns:
            The bytes that each radio says, int64 [envs, r]; the messages (column) that arrive at
            each radio, bool [envs, r, r]; and which entries have changed by whose message, as
            (environment, hearer, speaker, entry), int64 [4, k].
        """
        entry, code, sent = self._speak(known, step, left)
        now = torch.stack((hears & (sent > 0).unsqueeze(1), self.got), 1)
        arrives, acks = self.links(now).unbind(1)
        if self.config.delay:
            entry, code = self._fly(entry, code, step, arrives.any(1))
        self.acknowledged.copy_(arrives & acks.mT)
        told, at = arrives.unsqueeze(-1) & acks.unsqueeze(1), step.int().view(-1, 1, 1, 1)
        torch.where(told, at, self.reached, out=self.reached)
        self.got.copy_(arrives)
        torch.where(arrives, at.squeeze(-1), self.heard, out=self.heard)
        reaches = _lately(self.reached, at)
        reaches.diagonal(dim1=2, dim2=3).fill_(True)
        passes = (self.contact.unsqueeze(2) > reaches).any(-1)
        return sent, arrives, self._listen(known, entry, code, arrives, passes)

    def _fly(
        self, entry: Tensor, code: Tensor, step: Tensor, heard: Tensor
    ) -> tuple[Tensor, Tensor]:
        """Sends entries; returns the arriving ones, as indices into `codes`, and their codes."""
        (_, radios, items), slots = self.shape, self.config.delay + 1
        env = entry // (radios * items)
        sent = entry + ((slots - 1) * env + (step % slots)[env]) * radios * items
        self.codes.view(-1)[sent] = code
        self.said_at.view(-1)[sent] = step.int()[env]
        env, radio = heard.nonzero(as_tuple=True)
        row = (env * slots + ((step + 1) % slots)[env]) * radios + radio
        then = (step - self.config.delay).int()[env].unsqueeze(-1)
        sent = _marked(self.said_at.view(-1, items).index_select(0, row) == then, row)
        return sent, self.codes.view(-1)[sent]

    def _speak(
        self, known: Knowledge, step: Tensor, left: Tensor | None
    ) -> tuple[Tensor, Tensor, Tensor]:
        """Returns the entries said and their codes, [k] each, and the bytes, int64 [envs, r]."""
        radios, items = self.shape[1:]
        contact = _lately(self.heard, step.int().view(-1, 1, 1))
        met = (contact & ~self.contact).any(-1)
        other = (contact != self.contact).any(-1)
        self.pending[other] = _OPEN * self.pending[other].clamp(max=1)
        self.pending[met] = _OPEN * (known.last_seen[met] >= 0).char()
        self.contact.copy_(contact)
        active = contact.any(-1).view(-1).nonzero().squeeze(-1)
        pending = self.pending.flatten(0, 1).index_select(0, active)
        entry = _marked(pending, active, _OPEN)
        row = entry // items
        mine, theirs = codes(known, entry), self.has.view(-1, radios)[entry]
        now = step.int()[row // radios]
        told, at = self.told.view(-1)[entry], self.told_at.view(-1)[entry]
        due = (at == now - self.wait).nonzero().squeeze(-1)
        back = self.acknowledged.flatten(0, 1)[row[due]]
        after = merged(theirs[due], torch.where(back, told[due].unsqueeze(-1), _NOTHING))
        self.has.view(-1, radios)[entry[due]] = theirs[due] = after
        waits = (at >= 0) & (now - at < self.wait)
        told = torch.where(waits, told, _NOTHING)
        lacks = contact.flatten(0, 1)[row] & newer(mine.unsqueeze(-1), theirs)
        wanted = lacks.any(-1)
        self.pending.view(-1)[entry] = wanted * torch.where(waits, _OPEN, _LACKING).char()
        says = wanted & (told != mine)
        spent, left = self._open(left)
        if left is None:
            entry, mine = entry[says], mine[says]
        else:
            expected = merged(theirs, told.unsqueeze(-1))
            gain = (self._gain(mine.unsqueeze(-1), expected) * lacks).sum(-1)
            # The order of equal gains depends on the radio, so that radios say different entries.
            turned = (entry + row % radios * (items // radios)) % items
            self.rank.view(-1)[entry] = (says * ((gain + 1) * items - turned)).int()
            entry = self._best(active, left)
            self.rank.view(-1)[entry] = 0
            mine = codes(known, entry)
        row = entry // items
        self.pending.view(-1)[entry] = _OPEN  # until it is acknowledged or said again
        self.told.view(-1)[entry] = mine
        self.told_at.view(-1)[entry] = step.int()[row // radios]
        sent = spent.view(-1).index_add(0, row, self.sizes[entry % items]).view_as(spent)
        return entry, mine, sent

    def _open(self, left: Tensor | None) -> tuple[Tensor, Tensor | None]:
        """Returns the bytes of headers and acknowledgements, and the bytes left, int64 [envs, r].

        Acknowledgements that do not fit are dropped.
        """
        if left is not None:
            needed = self.header + ACKNOWLEDGEMENT * self.got.cumsum(-1)
            self.got &= needed <= left.unsqueeze(-1)
        spent = self.header + ACKNOWLEDGEMENT * self.got.sum(-1)
        if left is None:
            return spent, None
        speaks = left >= self.header
        return spent * speaks, (left - spent) * speaks

    def _gain(self, mine: Tensor, theirs: Tensor) -> Tensor:
        """Returns the steps by which looks get newer, from step -1 where fire is news."""
        before = torch.where(mine & 1 > theirs & 1, -1, theirs >> self.bits)
        return ((mine >> self.bits) - before).clamp(0, OLD)

    def _best(self, row: Tensor, left: Tensor) -> Tensor:
        """Returns the entries of the highest ranks in rows of maps, as many as the bytes allow."""
        items = self.shape[2]
        # Where the smallest entry fits, at most all the larger ones are passed over.
        most = int(left.max()) // self.smallest + self.larger
        left = left.view(-1, 1)[row]
        rank, item = self.rank.flatten(0, 1).index_select(0, row).topk(min(most, items))
        size = self.sizes[item]
        size *= (rank > 0) & (size <= left)
        says = (size > 0) & (size.cumsum(-1) <= left)
        return (item + items * row.unsqueeze(-1))[says]

    def _listen(
        self, known: Knowledge, entry: Tensor, code: Tensor, arrives: Tensor, passes: Tensor
    ) -> Tensor:
        """Enters what arrives into the maps; returns the changes, see `forward`.

        `passes`, bool [envs, r, r]: whether a radio passes on the entries of another one (column).
        """
        radios, items = self.shape[1:]
        row, cell = entry // items, entry % items
        env, speaker = row // (radios * self.codes.shape[1]), row % radios
        which, hearer = arrives.mT[env, speaker].nonzero(as_tuple=True)
        target = (env * radios * items + cell)[which] + hearer * items
        code, last, seen = code[which], known.last_seen, known.seen_fire
        changed = newer(code, codes(known, target))
        passed = changed & passes[env[which], hearer, speaker[which]]
        self._reopen(target, passed | (self.pending.take(target) > 0))
        assert seen is not None
        last.view(-1).scatter_reduce_(0, target, (code >> 1).to(last.dtype), "amax")
        mark(seen, target, (code & 1) > 0)
        at = target * radios + speaker[which]
        self.has.view(-1)[at] = merged(self.has.view(-1)[at], code)
        new = (changed & (code >> 1 == last.take(target))).nonzero().squeeze(-1)
        which = which[new]
        return torch.stack((env[which], hearer[new], speaker[which], cell[which]))


def _lately(at: Tensor, step: Tensor) -> Tensor:
    """Returns which steps are among the last `CONTACT`."""
    return at > step - CONTACT


def share(
    known: Knowledge,
    exchange: Exchange | None,
    view: View,
    step: Tensor,
    hears: Tensor,
    left: Tensor | None,
) -> Tensor | None:
    """Adds the sightings and messages of a step to maps; at once and along any path without limits.

    Args:
        view: the cells in view.
        step: int64 [envs], steps since the episode began.
        hears, left: see `Exchange.forward`.

    Returns:
        The bytes that each radio says, int64 [envs, r]; None without an exchange.
    """
    if exchange is None:
        known.update(view, step, hears)
        return None
    known.see(view, step.view(-1, 1, 1))
    exchange.saw(view)
    sent, arrives, _ = exchange(known, hears, step, left)
    known.reach.copy_(arrives).diagonal(dim1=1, dim2=2).fill_(True)
    return sent


def cell_bytes(horizon: int) -> int:
    """Returns the bytes of a message about a cell: index (2), step of the last look, state (1)."""
    return 3 + step_bytes(horizon)


def step_bytes(horizon: int) -> int:
    """Returns the bytes of a step in a message."""
    return 2 if horizon < 2**16 else 4


def codes(known: Knowledge, entry: Tensor) -> Tensor:
    """Returns the codes of entries of the flat maps, int32."""
    assert known.seen_fire is not None
    return 2 * known.last_seen.take(entry).int() + known.seen_fire.take(entry)


def newer(told: Tensor, theirs: Tensor) -> Tensor:
    """Returns whether a code is of a newer look, or of the first one in flames."""
    return (told > theirs) | (told & 1 > theirs & 1)


def merged(one: Tensor, other: Tensor) -> Tensor:
    """Returns the code of the newer look, with the fire that either has seen."""
    return torch.maximum(one, other) | (one | other) & 1


def _marked(flags: Tensor, row: Tensor, bit: int = 1) -> Tensor:
    """Returns the flat indices, sorted, of flags with a bit [rows, items], of rows of a table."""
    items = flags.shape[1]
    # Eight flags are read at a time, as most of them are not set.
    maps = flags.flatten().view(torch.int8)
    eights = nn.functional.pad(maps, (0, -len(maps) % 8)).view(-1, 8)
    some = (eights.view(torch.int64) & 0x0101010101010101 * bit).squeeze(-1).nonzero().squeeze(-1)
    flag = (eights[some] & bit).bool()
    at = (8 * some.unsqueeze(-1) + torch.arange(8, device=maps.device))[flag]
    return row.take(at // items) * items + at % items
