"""The contract of everything that happens in a control cycle, and how blocks become one Function.

Theory: docs/theory.md.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from itertools import accumulate
from operator import attrgetter
from typing import NoReturn, cast

import casadi as ca

from fpirhc.errors import InvalidName, InvalidValue, nearest
from fpirhc.symbolic.expression import Expression, Matrix, Signals, Value, kind
from fpirhc.symbolic.layout import Layout, Signal
from fpirhc.symbolic.open import settings_among, with_settings

Step = Callable[[Signals], Mapping[str, Value]]
PREFIX = "fpirhc_"  # keeps generated C names away from those of libc


@dataclass(frozen=True, eq=False)
class Block:
    """A named step: (reads, memory) -> (writes, memory).

    Args:
        name: of the block and of its Function.
        reads: signals that the step reads.
        writes: signals that the step writes.
        step: function of one object that has every read and remembered signal as an attribute. It returns a mapping with every
            written signal and, for each remembered signal m, 'm_next'.
        memory: signals that the block remembers.
        opaque: whether the step holds operations that scalar expressions cannot (solver calls, table look-up, short circuits);
            the block is then built with MX.
        inside: the composed step that the block runs, where it is nothing but the guard of one.
    """

    name: str
    reads: Layout
    writes: Layout
    step: Step
    memory: Layout = field(default_factory=Layout)
    opaque: bool = False
    inside: Composite | None = None

    @property
    def function(self) -> ca.Function:
        """Function of (each of `inputs`, each remembered) -> (each written, each remembered, one cycle later)."""
        return self._built[0]

    @cached_property
    def inputs(self) -> Layout:
        """The signals that are read, and the settings that are open in the step."""
        return self._built[1]

    @cached_property
    def _built(self) -> tuple[ca.Function, Layout]:
        matrix = kind(self.opaque)
        sizes = self.reads.sizes | self.memory.sizes
        symbols = dict(zip(sizes, map(matrix.sym, sizes, sizes.values()), strict=True))
        values = self.step(Signals(symbols))
        results = []
        of_results = (*self.writes.sizes.values(), *self.memory.sizes.values())
        for key, size in zip(self._results, of_results, strict=True):
            if key not in values:
                raise InvalidName(f"block '{self.name}' does not give '{key}'.{nearest(key, values)}")
            written = values[key]
            value = written if isinstance(written, matrix) else matrix(written)
            if value.numel() != size:
                raise InvalidValue(f"block '{self.name}' gives '{key}' with {value.numel()} entries, expected {size}")
            is_column = value.is_dense() and value.is_column()  # not built anew, which costs more than most operations
            results.append(value if is_column else ca.densify(value.reshape((value.numel(), 1))))
        name, columns, free = PREFIX + self.name, list(symbols.values()), {"allow_free": True}
        function = ca.Function(name, columns, results, list(symbols), list(self._results), free)
        return with_settings(function, self.reads, symbols, results)

    @cached_property
    def _results(self) -> dict[str, Signal]:
        """The signals that the step returns, by their keys."""
        keys = (*self.writes.names, *map("{}_next".format, self.memory.names))
        return dict(zip(keys, (*self.writes.signals, *self.memory.signals), strict=True))


@dataclass(frozen=True, eq=False)
class Delay:
    """A signal carried to the next cycle.

    Args:
        now: the signal that is read; its value is that of `source` one cycle earlier, and its start value in the first cycle.
        source: name of the signal that is carried.
    """

    now: Signal
    source: str


@dataclass(frozen=True, eq=False)
class Composite:
    """Blocks as one step: `function` maps (memory, each read...) to (memory, trace)."""

    name: str
    blocks: tuple[Block, ...]
    delays: tuple[Delay, ...]
    reads: Layout
    memory: Layout
    trace: Layout
    outputs: tuple[str, ...] = ()

    @cached_property
    def graph(self) -> ca.Function:
        """The step as a graph of calls."""
        inputs = {s.name: ca.MX.sym(s.name, s.size) for s in self.reads.signals}
        remembered, next_memory = ca.MX.sym("memory", self.memory.size), dict[str, ca.MX]()
        known: dict[str, ca.MX] = {**self.memory.split(remembered), **inputs}
        for block in self.blocks:
            call(block, known, next_memory)
        for delay in self.delays:
            next_memory[delay.now.name] = known[delay.source]
        returned = [self.memory.join(next_memory), self.trace.join(known), *[known[o] for o in self.outputs]]
        return ca.Function(
            PREFIX + self.name,
            [remembered, *inputs.values()],
            [ca.densify(ca.MX(r)) for r in returned],
            ["memory", *inputs],
            ["memory_next", "trace", *self.outputs],
        )

    @cached_property
    def function(self) -> ca.Function:
        """The step; scalar code where every block is."""
        if self.opaque:
            return self.graph
        # All calls are written out, and common parts of blocks computed once.
        graph = self.graph
        inputs = [ca.SX.sym(graph.name_in(k), graph.size1_in(k)) for k in range(graph.n_in())]
        shared = ca.cse([ca.SX(v) for v in graph.call(inputs)])
        return ca.Function(graph.name(), inputs, shared, graph.name_in(), graph.name_out())

    @cached_property
    def opaque(self) -> bool:
        """Whether some block holds operations that scalar expressions cannot."""
        return any(map(attrgetter("opaque"), self.blocks))


def compose(
    name: str,
    reads: Layout,
    blocks: Sequence[Block],
    delays: Sequence[Delay] = (),
    outputs: Sequence[str] = (),
    constants: Sequence[Signal] = (),
) -> Composite:
    """Wire blocks, in order, by signal name into one step, which returns the traced `outputs` once more by themselves.

    `constants` are remembered as they were in the first cycle, and with them the settings that are open in the blocks. Without
    constants the step reads these settings.
    """
    settings = settings_among(block.inputs for block in blocks)
    kept = (*constants, *settings) if constants else ()
    delays = (*delays, *(Delay(signal, signal.name) for signal in kept))
    memory = Layout((*[d.now for d in delays], *[s for b in blocks for s in b.memory.signals]))
    held = {*reads.names, *memory.names}
    reads = Layout((*reads.signals, *[s for s in settings if s.name not in held]))
    _require_wired(reads, memory, blocks, delays)
    trace = Layout(tuple([s for b in blocks for s in b.writes.signals if not s.name.startswith("_")]))
    return Composite(name, tuple(blocks), delays, reads, memory, trace, tuple(outputs))


def _require_wired(reads: Layout, memory: Layout, blocks: Sequence[Block], delays: Sequence[Delay]) -> None:
    """Raise where a signal is read that is not there or has another size, or is written twice."""
    sizes = memory.sizes | reads.sizes
    for block in blocks:
        inputs = block.inputs
        for name, size in inputs.sizes.items():
            if sizes.get(name) != size:
                _refuse_size(f"block '{block.name}'", inputs[name], name, sizes)
        for name, size in block.writes.sizes.items():
            if name in sizes:
                raise InvalidName(f"block '{block.name}' writes '{name}', which is already written")
            sizes[name] = size
    for delay in delays:
        if sizes.get(delay.source) != memory.sizes[delay.now.name]:
            _refuse_size(f"delay '{delay.now.name}'", delay.now, delay.source, sizes)


def call(block: Block, known: dict[str, Matrix], next_memory: dict[str, Matrix]) -> None:
    """Evaluate a block: what it writes is added to the known signals, what it remembers to the next memory."""
    # Of graphs they are MX, which the stub does not mix with SX.
    arguments = cast(list[ca.SX], list(map(known.__getitem__, (*block.inputs.names, *block.memory.names))))
    values = block.function.call(arguments)
    results = cast(dict[str, Matrix], dict(zip(block._results, values, strict=True)))
    for name in block.writes.names:
        known[name] = results[name]
    for m in block.memory.names:
        next_memory[m] = results[f"{m}_next"]


def fed(block: Block, name: str, source: Signal) -> Block:
    """Return the block with `source` in place of the signal `name`; a block that does not read `name` stays as it is."""
    if name not in block.reads:
        return block
    reads = {one.name: one for one in (source if s.name == name else s for s in block.reads.signals)}

    def step(s: Signals) -> Mapping[str, Value]:
        return block.step(Signals({**vars(s), name: getattr(s, source.name)}))

    return replace(block, reads=Layout(tuple(reads.values())), step=step)


def under_names(block: Block, names: Mapping[str, str]) -> Block:
    """Return the block with other names for the signals that it reads, writes and remembers."""

    def other(layout: Layout) -> Layout:
        return Layout(tuple(replace(s, name=names.get(s.name, s.name)) for s in layout.signals))

    def step(s: Signals) -> dict[str, Value]:
        incoming = {names.get(n, n): n for n in (*block.reads.names, *block.memory.names)}
        values = block.step(Signals({n: getattr(s, new) for new, n in incoming.items()}))
        later = {f"{n}_next": f"{names.get(n, n)}_next" for n in block.memory.names}
        return {later.get(n, names.get(n, n)): value for n, value in values.items()}

    reads, writes, memory = map(other, (block.reads, block.writes, block.memory))
    return replace(block, reads=reads, writes=writes, memory=memory, step=step)


def rename(name: str, source: Signal, target: Signal) -> Block:
    """Block that gives `source` a second name."""
    return Block(name, Layout((source,)), Layout((target,)), lambda s: {target.name: getattr(s, source.name)})


def every(block: Block, cycles: int) -> Block:
    """Return a block that runs `block` in every `cycles`-th cycle and holds its writes in between."""
    if cycles < 1:
        raise InvalidValue(f"block '{block.name}' is to run every {cycles} cycles; expected 1 or more")
    if cycles == 1:
        return block
    phase = Signal(f"{block.name}_phase")
    held = Layout(tuple(replace(s, name=f"{block.name}_held_{s.name}") for s in block.writes.signals))
    own = Layout((phase, *held.signals)) + block.memory
    run, hold = _branches(block, held)

    def step(signals: Signals) -> dict[str, Expression]:
        arguments = [getattr(signals, n) for n in (*held.names, *block.inputs.names, *block.memory.names)]
        choice = ca.Function.if_else(f"{PREFIX}{block.name}_every", run, hold)
        due = getattr(signals, phase.name) < 0.5
        column = choice(due, *arguments)
        ends = [0, *accumulate(signal.size for signal in block._results.values())]
        values = dict(zip(block._results, ca.vertsplit(column, ends), strict=True))
        values |= {f"{h}_next": values[s] for h, s in zip(held.names, block.writes.names, strict=True)}
        next_phase = getattr(signals, phase.name) + 1
        values[f"{phase.name}_next"] = ca.if_else(next_phase > cycles - 0.5, 0, next_phase)
        return values

    return Block(f"{block.name}_every_{cycles}", block.inputs, block.writes, step, own, opaque=True)


def _branches(block: Block, held: Layout) -> tuple[ca.Function, ca.Function]:
    """The two sides of the switch, both (held writes, reads, memory) -> one column of results."""
    last_writes = [ca.MX.sym(s.name, s.size) for s in held.signals]
    reads = [ca.MX.sym(s.name, s.size) for s in block.inputs.signals]
    memory = [ca.MX.sym(s.name, s.size) for s in block.memory.signals]
    results = block.function(*reads, *memory)
    new = ca.vertcat(*results) if isinstance(results, tuple) else results
    arguments = [*last_writes, *reads, *memory]
    run = ca.Function(f"{PREFIX}{block.name}_run", arguments, [new])
    hold = ca.Function(f"{PREFIX}{block.name}_hold", arguments, [ca.vertcat(*last_writes, *memory)])
    return run, hold


def _refuse_size(reader: str, signal: Signal, source: str, sizes: Mapping[str, int]) -> NoReturn:
    if source not in sizes:
        raise InvalidName(f"{reader} reads '{source}', which no earlier block writes.{nearest(source, sizes)}")
    raise InvalidValue(f"{reader} reads '{source}' with {signal.size} entries, but it has {sizes[source]}")
