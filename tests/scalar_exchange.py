"""Re-implements the exchange of maps message by message, with dictionaries."""

NOTHING = (-1, False)


def lacks(look, theirs) -> bool:
    return look[0] > theirs[0] or (look[1] and not theirs[1])


def joined(one, other):
    return max(one[0], other[0]), one[1] or other[1]


class ScalarExchange:
    """The radios of a team; a look is (number in the map, whether it was seen in flames).

    Args:
        sizes: bytes of each entry.
        delay, unit: steps from sending to receiving, and numbers of a map per step.
    """

    def __init__(self, radios: int, sizes, delay: int, unit: int):
        everyone = self.everyone = range(radios)
        self.sizes, self.delay, self.unit, self.wait = sizes, delay, unit, 2 * delay + 2
        self.known = [{} for _ in everyone]
        self.has = [[{} for _ in everyone] for _ in everyone]
        self.told = [{} for _ in everyone]  # entry -> (look, step)
        self.pending: list[set] = [set() for _ in everyone]
        self.contact: list[list] = [[] for _ in everyone]
        self.reached = [[{} for _ in everyone] for _ in everyone]  # hearer, speaker: radio -> step
        self.heard = [{} for _ in everyone]  # radio -> step
        self.got = [[] for _ in everyone]
        self.acknowledged = [[] for _ in everyone]
        self.flying: list[tuple] = []  # (arrives at, speaker, hearer, looks, acknowledgements)
        self.sent = self.lost = self.arrived = 0
        self.waits = [0] * radios

    def see(self, radio: int, looks: dict) -> None:
        self.pending[radio] |= set(looks)
        self._enter(radio, looks)

    def _enter(self, radio: int, looks: dict) -> None:
        for entry, look in looks.items():
            self.known[radio][entry] = joined(look, self.known[radio].get(entry, NOTHING))

    def step(self, step: int, near, hears, left) -> tuple[list[int], list[list[bool]]]:
        """Returns the bytes of each radio, and which messages (column) arrive at each."""
        spent = [self._speak(i, step, left[i], near, hears) for i in self.everyone]
        arriving = [m for m in self.flying if m[0] == step]
        self.flying = [m for m in self.flying if m[0] > step]
        self.got = [[] for _ in self.everyone]
        self.acknowledged = [[] for _ in self.everyone]
        heard = []
        for _, speaker, hearer, looks, acks in arriving:
            self.arrived += 1
            self.got[hearer].append(speaker)
            self.heard[hearer][speaker] = step
            if hearer in acks:
                self.acknowledged[hearer].append(speaker)
            self.reached[hearer][speaker] |= dict.fromkeys(acks, step)
            theirs = self.has[hearer][speaker]
            for entry, look in looks.items():
                theirs[entry] = joined(look, theirs.get(entry, NOTHING))
            new = {e for e, x in looks.items() if lacks(x, self.known[hearer].get(e, NOTHING))}
            heard.append((hearer, speaker, looks, new))
        for hearer, speaker, looks, new in heard:
            reached = {j for j, at in self.reached[hearer][speaker].items() if step - at < 10}
            if set(self.contact[hearer]) - reached - {speaker}:
                self.pending[hearer] |= new
            self._enter(hearer, looks)
        return spent, [[j in self.got[i] for j in self.everyone] for i in self.everyone]

    def _speak(self, i: int, step: int, left, near, hears) -> int:
        told = self.told[i]
        for j in self.acknowledged[i]:
            for entry, (look, when) in told.items():
                if when == step - self.wait:
                    self.has[i][j][entry] = joined(look, self.has[i][j].get(entry, NOTHING))
        offers = [entry for _, entry in sorted(self._offers(i, step))]
        self.waits[i] = sum(self.sizes[entry] for entry in offers)
        if left is not None and left < 2:
            return 0
        acks, spent, said = [], 2, {}
        for j in sorted(self.got[i]):
            if left is None or spent + 2 <= left:
                acks.append(j)
                spent += 2
        if left is not None:
            left -= spent
        for entry in offers:
            if left is not None and self.sizes[entry] > left:
                continue
            said[entry] = self.known[i][entry]
        if left is not None:
            total, fits = 0, {}
            for entry, look in said.items():
                total += self.sizes[entry]
                if total <= left:
                    fits[entry] = look
            said = fits
        told.update({entry: (look, step) for entry, look in said.items()})
        for k in self.everyone:
            if near[k][i]:
                self.sent += 1
                self.lost += not hears[k][i]
                if hears[k][i]:
                    self.flying.append((step + self.delay, i, k, said, acks))
        self.waits[i] -= sum(self.sizes[entry] for entry in said)
        return spent + sum(self.sizes[entry] for entry in said)

    def _offers(self, i: int, step: int) -> list:
        """Returns the entries that radios in range may lack, with their sort keys."""
        told, contact = self.told[i], [j for j, at in self.heard[i].items() if step - at < 10]
        if set(contact) - set(self.contact[i]):
            self.pending[i] = set(self.known[i])
        self.contact[i] = contact
        offered = []
        for entry in sorted(self.pending[i]) if contact else []:
            look = self.known[i][entry]
            last, when = told.get(entry, (NOTHING, -1))
            recent = when >= 0 and step - when < self.wait
            gain, wanted = 0, False
            for j in contact:
                theirs = self.has[i][j].get(entry, NOTHING)
                if lacks(look, theirs):
                    wanted = True
                    theirs = joined(theirs, last) if recent else theirs
                    before = -1 if look[1] and not theirs[1] else theirs[0] // self.unit
                    gain += min(100, max(0, look[0] // self.unit - before))
            self.pending[i] -= set() if wanted else {entry}
            if wanted and not (recent and last == look):
                items = len(self.sizes)
                turned = (entry + i * (items // len(self.known))) % items
                offered.append(((-gain, turned), entry))
        return offered
