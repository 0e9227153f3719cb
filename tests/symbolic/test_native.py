"""Compiled code: same numbers, a cache that is never wrong, and a fallback that says why."""

from __future__ import annotations

import ctypes
import multiprocessing
import os
import pickle
import re
import stat
import subprocess
import threading
import time
from dataclasses import replace
from typing import Any

import casadi as ca
import numpy as np
import pytest

import fpirhc as fp
from fpirhc.symbolic import native as module
from fpirhc.symbolic.driver import SIGNATURE, Driver, finite, with_driver
from fpirhc.symbolic.evaluate import Evaluator
from fpirhc.symbolic.expression import expression, graph
from fpirhc.symbolic.native import compiling_ahead, find_compiler, native
from fpirhc.symbolic.program import chained, generate

needs_compiler = pytest.mark.skipif(find_compiler() is None, reason="this machine has no C compiler")


@pytest.fixture
def cache(tmp_path, monkeypatch):
    """An empty cache, on disk and in memory."""
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "cache"))
    monkeypatch.setattr(module, "_loaded", {})
    return tmp_path / "cache" / module.own_name()


def model(factor: float, size: int = 3) -> ca.Function:
    """A small Function whose code depends on `factor`."""
    x = ca.SX.sym("x", size)
    return ca.Function("fpirhc_model", [x], [factor * ca.sin(x) + x**2])


def _libraries(cache):
    return sorted(p for p in cache.iterdir() if p.suffix in {".so", ".dylib", ".dll"})


@needs_compiler
def test_same_numbers_as_the_virtual_machine(cache):
    """Contraction of multiply-add is off, so both round alike."""
    x = np.linspace(-3, 3, 3)
    result = native(model(2.0))
    assert result.compiled
    np.testing.assert_array_equal(result.function(x).full(), model(2.0)(x).full())


@needs_compiler
def test_own_flags_make_another_library_with_the_same_numbers(cache, monkeypatch):
    """A plan whose loops are written in C, not optimised and optimised."""
    task = fp.load_problem("leaking_tanks")
    problem = replace(task.problem, duration=20 * task.problem.period, measure_from=0.0)
    digests, counts = set(), []
    for flags in ("", "-O0 -DFPIRHC_UNUSED='a word'"):
        monkeypatch.setenv("FPIRHC_CFLAGS", flags)
        run = fp.simulate(problem, task.controllers["RHC+FPI"], seed=0, compiled=True)
        digests.add(run["command"].tobytes())
        counts.append(len(_libraries(cache)))
    assert len(digests) == 1
    assert counts[1] == 2 * counts[0]


@needs_compiler
@pytest.mark.parametrize("count", [37, 5, 1])
def test_a_chain_of_calls_is_that_of_the_virtual_machine(cache, count):
    """Memory after so many calls, and the results of these; what is read follows call by call."""
    x, u = ca.SX.sym("x", 2), ca.SX.sym("u")
    step = ca.Function("fpirhc_step", [x, u], [0.5 * x + u, x - u])
    many = step.mapaccum("fpirhc_many", 37)
    values = np.arange(37.0)
    expected = [one.full() for one in many([1.0, 2.0], values)]
    for chain in (native(step, calls=37).function, chained(step, 37, 5)):
        after, shown = (one.full() for one in chain([1.0, 2.0], values, count))
        np.testing.assert_array_equal(after[:, 0], expected[0][:, count - 1])
        np.testing.assert_array_equal(shown[:, :count], expected[1][:, :count])


@needs_compiler
@pytest.mark.parametrize("damage", [False, True])
def test_libraries_share_the_object_of_a_driver(cache, monkeypatch, damage):
    """The second of two Functions that call the same driver compiles its own file only, unless the kept object is damaged."""
    compiled: list[str] = []
    run = module._run

    def counted(command):
        compiled.extend(word for word in command if word.endswith(".c"))
        return run(command)

    text = f"int ENTRY{SIGNATURE} {{ return leaf(arg, res, iw, w, mem); }}"
    inner = with_driver("fpirhc_shared", Driver(text, {"leaf": model(5.0)}, {}), lambda name: renamed(model(5.0), name))
    x = ca.MX.sym("x", 3)
    first, second = (ca.Function("fpirhc_outer", [x], [factor * inner(x)]) for factor in (2, 3))
    monkeypatch.setattr(module, "_run", counted)
    at = np.array([0.3, 0.7, -2.0])
    np.testing.assert_array_equal(native(first).function(at).full(), first(at).full())
    assert len(compiled) == 2
    if damage:
        [kept] = cache.glob("*.o")
        kept.write_bytes(kept.read_bytes()[:-1])
    np.testing.assert_array_equal(native(second).function(at).full(), second(at).full())
    assert len(compiled) == (4 if damage else 3)


@needs_compiler
@pytest.mark.parametrize("fails", [False, True])
def test_compilers_at_work_side_by_side_do_nothing_twice(cache, monkeypatch, fails):
    """Two begun libraries are found by `native`; they share a driver that is compiled once. What fails, fails for who asks."""
    compiled: list[str] = []
    run, barrier = module._run, threading.Barrier(2, timeout=60)

    def counted(command):
        compiled.extend(word for word in command if word.endswith(".c"))
        if command[-1].endswith("part0.c") and sum(word.endswith("part0.c") for word in compiled) <= 2:
            barrier.wait()  # both are at work
        return run([*command, "-fno-such-flag"] if fails else command)

    text = f"int ENTRY{SIGNATURE} {{ return leaf(arg, res, iw, w, mem); }}"
    inner = with_driver("fpirhc_shared", Driver(text, {"leaf": model(6.0)}, {}), lambda name: renamed(model(6.0), name))
    x = ca.MX.sym("x", 3)
    pair = [ca.Function("fpirhc_outer", [x], [factor * inner(x)]) for factor in (4, 5)]
    monkeypatch.setattr(module, "_run", counted)
    monkeypatch.setattr(os, "cpu_count", lambda: 2)
    with compiling_ahead() as begin:
        for function in pair:
            begin(function)
        if not fails:
            monkeypatch.setattr(module, "generate", lambda *_: pytest.fail("C is written again"))
        ready = [native(function) for function in pair]
    at = np.array([0.3, 0.7, -2.0])
    for function, one in zip(pair, ready, strict=True):
        np.testing.assert_array_equal(one.function(at).full(), function(at).full())
        assert one.compiled != fails
        assert ("no-such-flag" in one.reason) == fails
    assert fails or len(compiled) == 3
    assert not module._begun


def renamed(function: ca.Function, name: str) -> ca.Function:
    """The same Function under another name."""
    x = ca.MX.sym("x", function.sparsity_in(0))
    return ca.Function(name, [x], [function(x)])


@needs_compiler
def test_cache_is_by_content(cache, monkeypatch):
    """The same model compiles once, another model gets another library."""
    native(model(2.0))
    monkeypatch.setattr(module, "_loaded", {})
    native(model(2.0))
    assert len(_libraries(cache)) == 1
    native(model(3.0))
    assert len(_libraries(cache)) == 2
    assert not [p for p in cache.iterdir() if p.name.startswith("building-")]


@needs_compiler
def test_a_library_is_found_without_writing_c(cache, monkeypatch):
    """By the Function, compiler, flags and writer of C; whatever differs writes C, and its own library is found."""
    native(model(2.0))
    written: list[ca.Function] = []

    def noticed(function, calls):
        written.append(function)
        return generate(function, calls)

    monkeypatch.setattr(module, "generate", noticed)

    def writes(function, flags=()):
        monkeypatch.setattr(module, "_loaded", {})
        written.clear()
        found = native(function, flags)
        assert found.compiled
        np.testing.assert_array_equal(found.function(np.ones(3)).full(), function(np.ones(3)).full())
        return bool(written)

    assert not writes(model(2.0))
    assert writes(model(3.0))
    assert writes(model(2.0), ["-DOTHER"])
    assert not writes(model(2.0), ["-DOTHER"])
    with monkeypatch.context() as patch:
        patch.setattr(module, "_version", lambda _: "another compiler")
        assert writes(model(2.0))
    with monkeypatch.context() as patch:
        patch.setattr(module, "_writer", lambda: "another program")
        assert writes(model(2.0))
    assert not writes(model(2.0))


@needs_compiler
def test_calls_in_a_chain_have_a_library_of_their_own(cache, monkeypatch):
    """It hands on what is remembered; another number of calls has another library, which is found without writing its C."""
    x = np.linspace(-1.0, 1.0, 3)
    for calls in (4, 5, 5):
        expected = model(0.5).mapaccum("chain", calls)(x)[:, -1]
        np.testing.assert_array_equal(native(model(0.5), calls=calls).function(x, calls).full(), expected.full())
    np.testing.assert_array_equal(native(model(0.5)).function(x).full(), model(0.5)(x).full())
    assert len(_libraries(cache)) == 3
    monkeypatch.setattr(module, "_loaded", {})
    monkeypatch.setattr(module, "generate", lambda *_: pytest.fail("its C was written again"))
    np.testing.assert_array_equal(native(model(0.5), calls=5).function(x, 5).full(), expected.full())


@needs_compiler
@pytest.mark.parametrize("damage", [b"", b"not a library", None])
def test_damaged_library_is_built_again(cache, damage):
    """Truncated, overwritten, or with a lost checksum: the answer is right and the cache is whole again."""
    native(model(4.0))
    (path,) = _libraries(cache)
    checksum = path.with_suffix(".sha256")
    if damage is None:
        checksum.unlink()
    else:
        # A new file, as a crash leaves it: the old library is still mapped into this process.
        path.unlink()
        path.write_bytes(damage)
    assert not module._is_intact(path)
    module._loaded.clear()
    np.testing.assert_array_equal(native(model(4.0)).function(np.ones(3)).full(), model(4.0)(np.ones(3)).full())
    assert module._is_intact(path)


def _work(arguments):
    factor, folder = arguments
    import os

    os.environ["FPIRHC_CACHE"] = folder
    result = native(model(factor))
    return result.compiled, result.function(np.ones(3)).full().ravel().tolist()


@needs_compiler
def test_processes_may_compile_at_once(cache):
    """Eight compilations of four models in four processes: every process gets its own model's numbers."""
    factors = [1.5, 2.5, 3.5, 4.5] * 2
    with multiprocessing.get_context("spawn").Pool(4) as pool:
        results = pool.map(_work, [(f, str(cache.parent)) for f in factors], chunksize=1)
    for factor, (compiled, values) in zip(factors, results, strict=True):
        assert compiled
        assert values == pytest.approx((factor * np.sin(np.ones(3)) + 1).tolist(), rel=1e-15)
    assert len(_libraries(cache)) == 4


def test_no_compiler_is_announced(cache, monkeypatch):
    """Turned off, the Function itself comes back with the reason."""
    monkeypatch.setenv("FPIRHC_CC", "none")
    function = model(2.0)
    result = native(function)
    assert not result.compiled
    assert result.function is function
    assert "FPIRHC_CC=none" in result.reason


def test_failing_compiler_falls_back_with_its_message(cache, monkeypatch, tmp_path):
    """A compiler that fails is no reason to stop."""
    broken = tmp_path / "cc"
    broken.write_text("#!/bin/sh\necho 'no space left' >&2\nexit 1\n")
    broken.chmod(broken.stat().st_mode | stat.S_IXUSR)
    monkeypatch.setenv("FPIRHC_CC", str(broken))
    result = native(model(2.0))
    assert not result.compiled
    assert "no space left" in result.reason
    assert float(result.function(0.0)[0]) == 0.0


@needs_compiler
def test_hostile_folder_names_are_only_names(tmp_path, monkeypatch):
    monkeypatch.setattr(module, "_loaded", {})
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "a; touch owned; $(touch owned) b"))
    assert native(model(2.0)).compiled
    assert not list(tmp_path.rglob("owned"))


@needs_compiler
def test_folder_that_cannot_be_written_is_replaced(tmp_path, monkeypatch):
    (tmp_path / "taken").write_text("")
    monkeypatch.setattr(module, "_loaded", {})
    monkeypatch.setenv("FPIRHC_CACHE", str(tmp_path / "taken" / "cache"))
    assert native(model(6.0)).compiled


def test_solver_calls_stay_in_the_virtual_machine(cache):
    """IPOPT cannot be written as C; the reason says so."""
    x, p = ca.MX.sym("x"), ca.MX.sym("p")
    program: dict[str, ca.MX] = {"x": x, "p": p, "f": (x - p) ** 2}
    options: Any = {"ipopt.sb": "yes", "ipopt.print_level": 0, "print_time": False}
    solver = ca.nlpsol("solver", "ipopt", program, options)
    symbols = ca.MX.sym("given")
    result = native(ca.Function("fpirhc_solve", [symbols], [solver(p=symbols)["x"]]))
    assert not result.compiled
    assert float(result.function(3.0)) == pytest.approx(3.0)


def test_evaluator_speaks_column_major():
    """A (2, 3) matrix is an array of shape (3, 2), a column a flat one."""
    m, v = ca.SX.sym("m", 2, 3), ca.SX.sym("v", 3)
    evaluator = Evaluator(ca.Function("fpirhc_product", [m, v], [ca.mtimes(m, v), m.T]))
    matrix, column = np.arange(6.0).reshape(2, 3), np.array([1.0, -1.0, 2.0])
    product, transposed = evaluator(matrix.T, column)
    np.testing.assert_array_equal(product, matrix @ column)
    np.testing.assert_array_equal(transposed.T, matrix.T)


def test_evaluator_densifies_and_checks_shapes():
    """Structural zeros come back as zeros; a wrong number of entries names the argument."""
    x = ca.SX.sym("x", 2)
    evaluator = Evaluator(ca.Function("fpirhc_diagonal", [x], [ca.diag(x)], ["x"], ["d"]))
    np.testing.assert_array_equal(evaluator(np.array([1.0, 2.0]))[0], np.diag([1.0, 2.0]))
    with pytest.raises(ValueError, match="argument 'x' has 2 entries"):
        evaluator(np.ones(3))
    with pytest.raises(ValueError, match=r"expected 1 arguments \(x\), got 2"):
        evaluator(np.ones(2), 1.0)


def test_results_can_be_redirected_into_a_log():
    """The log is filled in place; an array that does not fit is refused, because only its address is kept."""
    evaluator = Evaluator(model(2.0))
    log = np.zeros((2, 3))
    for k in range(2):
        evaluator.arguments[0][:] = k
        evaluator.redirect(0, log[k])
        evaluator.evaluate()
    np.testing.assert_array_equal(log, [model(2.0)(k).full().ravel() for k in (np.zeros(3), np.ones(3))])
    for wrong in (np.zeros(2), np.zeros(3, dtype=np.float32), np.zeros((3, 2))[:, 0]):
        with pytest.raises(ValueError, match="contiguous float64"):
            evaluator.redirect(0, wrong)


def test_a_matrix_is_given_transposed_and_a_refused_call_changes_nothing():
    """A (2, 3) matrix that is not transposed would be scrambled without a word."""
    a, b = ca.SX.sym("a", 2, 3), ca.SX.sym("b")
    evaluator = Evaluator(ca.Function("fpirhc_scaled", [b, a], [b * a], ["b", "a"], ["c"]))
    matrix = np.arange(6.0).reshape(2, 3)
    np.testing.assert_array_equal(evaluator(2.0, matrix.T)[0], 2 * matrix.T)
    with pytest.raises(ValueError, match="given transposed"):
        evaluator(7.0, matrix)
    with pytest.raises(ValueError, match="not made of numbers"):
        evaluator(7.0, "matrix")
    assert evaluator.arguments[0] == 2.0


def test_an_evaluator_stays_in_its_process():
    """Its arrays are bound by address: a copy would write into the memory of another."""
    with pytest.raises(TypeError, match="cannot be copied"):
        pickle.dumps(Evaluator(model(1.0)))


@needs_compiler
def test_a_compiled_function_cannot_be_written_as_c_again():
    """It is kept as it is; inside another Function the reason says what to do."""
    compiled = native(model(2.0)).function
    assert native(compiled).compiled
    x = ca.MX.sym("x", 3)
    result = native(ca.Function("fpirhc_outer", [x], [compiled(x)]))
    assert not result.compiled
    assert "compile the whole instead" in result.reason


def test_a_compiler_asked_for_is_never_replaced(monkeypatch):
    """A missing FPIRHC_CC is announced by name, and no other compiler is taken."""
    monkeypatch.setenv("FPIRHC_CC", "no-such-compiler")
    result = native(model(3.0))
    assert not result.compiled
    assert "'no-such-compiler', asked for by FPIRHC_CC, was not found" in result.reason


# Other users


def _planted(cache, factor: float):
    """A library in the cache that is a valid one of another model, as a hostile user would leave it; and the right numbers."""
    native(model(factor))
    native(model(factor + 1.0))
    first, second = sorted(_libraries(cache), key=lambda p: p.stat().st_mtime_ns)
    path, other = first, second
    path.unlink()
    path.write_bytes(other.read_bytes())
    path.with_suffix(".sha256").write_bytes(other.with_suffix(".sha256").read_bytes())
    module._loaded.clear()
    return path


needs_posix = pytest.mark.skipif(os.name != "posix", reason="owners and modes of files are those of POSIX")


@needs_compiler
@needs_posix
@pytest.mark.parametrize("who", ["writable by others", "of another user", "a link"])
def test_library_that_others_may_have_written_is_not_run(cache, monkeypatch, who):
    """A library with a fitting checksum that is writable by others, of another user, or a link, is compiled again."""
    path = _planted(cache, 7.0)
    if who == "writable by others":
        path.chmod(0o777)
    elif who == "a link":
        hidden = path.with_name("elsewhere")
        path.rename(hidden)
        path.symlink_to(hidden)
    else:
        stranger = os.geteuid() + 1
        monkeypatch.setattr(module, "_is_own", lambda facts: facts.st_uid == stranger)
    assert not module._is_intact(path)
    result = native(model(7.0))
    np.testing.assert_array_equal(result.function(np.ones(3)).full(), model(7.0)(np.ones(3)).full())


@needs_posix
def test_folder_is_closed_to_others(cache):
    """Created with mode 0700 under any umask; one that was open is closed."""
    old = os.umask(0)
    try:
        assert stat.S_IMODE(module.cache_folder().stat().st_mode) == 0o700
        cache.chmod(0o1777)
        assert stat.S_IMODE(module.cache_folder().stat().st_mode) == 0o700
    finally:
        os.umask(old)


@needs_posix
def test_folder_of_another_user_is_not_used(cache, monkeypatch):
    cache.mkdir(parents=True)
    monkeypatch.setattr(module, "_is_own", lambda facts: False)
    assert module.cache_folder() != cache


@needs_posix
@needs_compiler
def test_a_shared_folder_stays_as_it_is(tmp_path, monkeypatch):
    """FPIRHC_CACHE may name a folder that others use, too: its mode and what is in it are theirs."""
    shared, theirs = tmp_path / "shared", tmp_path / "shared" / "building-a-house"
    theirs.mkdir(parents=True)
    os.utime(theirs, (0, 0))
    shared.chmod(0o1777)
    monkeypatch.setenv("FPIRHC_CACHE", str(shared))
    monkeypatch.setattr(module, "_loaded", {})
    assert native(model(9.0)).compiled
    own = shared / module.own_name()
    assert stat.S_IMODE(shared.stat().st_mode) == 0o1777
    assert sorted(shared.iterdir()) == sorted([theirs, own])
    assert (stat.S_IMODE(own.stat().st_mode), len(_libraries(own))) == (0o700, 1)


@needs_posix
def test_a_link_of_a_stranger_is_not_followed(cache, tmp_path, monkeypatch):
    """In a shared folder anybody can put a link to a folder of the user's in the place of the cache."""
    private = tmp_path / "documents"
    private.mkdir(mode=0o755)
    cache.parent.mkdir()
    cache.symlink_to(private)
    link = cache.lstat().st_ino
    monkeypatch.setattr(module, "_is_own", lambda facts: facts.st_ino != link)
    assert module.cache_folder() != cache
    assert stat.S_IMODE(private.stat().st_mode) == 0o755


@needs_compiler
@needs_posix
def test_fifo_in_place_of_a_checksum_does_not_hang(cache):
    """It is no regular file, so the library is compiled again."""
    native(model(8.0))
    (path,) = _libraries(cache)
    path.with_suffix(".sha256").unlink()
    os.mkfifo(path.with_suffix(".sha256"))
    module._loaded.clear()
    assert native(model(8.0)).compiled
    assert module._is_intact(path)


@needs_compiler
def test_what_killed_processes_left_behind_is_removed(cache):
    """The next compilation removes a folder that is older than any compilation, and no other."""
    for name, age in (("building-old", 7200.0), ("building-new", 10.0), ("mine", 7200.0)):
        (cache / name).mkdir(parents=True)
        (cache / name / "model.c").write_text("")
        then = time.time() - age
        os.utime(cache / name, (then, then))
    native(model(9.0))
    assert sorted(p.name for p in cache.iterdir() if p.is_dir()) == ["building-new", "mine"]


# Constants of the type that computes


@pytest.mark.parametrize("name", ["CTC+FPI (eq 6)", "RHC+FPI", "limits"])
def test_generated_code_has_no_number_that_a_float_cannot_hold(name):
    """1e300 is infinite in float, and then |v| <= 1e300 holds for an infinite v."""
    task = fp.load_problem("two_mass")
    problem, controller = task.problem, task.controllers["RHC+FPI" if name == "limits" else name]
    if name == "limits":
        problem = replace(problem, limits=replace(problem.limits, states={"q1": (1.85, 2.35)}))
    single = np.finfo(np.float32)
    for text in generate(fp.Stepper(problem, controller, compiled=False).function):
        numbers = re.findall(r"(?<![\w.])\d+\.?\d*(?:e[+-]?\d+)?", re.sub(r"/\*.*?\*/", "", text, flags=re.DOTALL))
        assert "FINITE" in text
        assert not [n for n in numbers if float(n) and not single.tiny <= float(n) <= single.max]


@needs_compiler
@pytest.mark.parametrize("real", ["double", "float"])
def test_a_column_is_finite_in_either_type(real, tmp_path):
    """The passes over a column in C read numbers of the type that they are compiled for; one bad entry is found at every place."""
    size = 19
    column = ca.MX.sym("x", size)
    function = ca.Function("fpirhc_fine", [column], [graph(finite(expression(column), opaque=True))])
    texts = [tmp_path / f"{k}.c" for k in range(2)]
    for path, text in zip(texts, generate(function), strict=True):
        path.write_text(text)
    built = str(tmp_path / "fine.so")
    command = [
        str(find_compiler()),
        "-shared",
        "-fPIC",
        "-O2",
        f"-Dcasadi_real={real}",
        *map(str, texts),
        "-o",
        built,
        "-lm",
    ]
    subprocess.run(command, check=True)
    kind = np.dtype({"double": np.float64, "float": np.float32}[real])
    called = ctypes.CDLL(built).fpirhc_native

    def fine(values: np.ndarray) -> float:
        row, answer, work = values.astype(kind), np.zeros(1, kind), np.zeros(64, kind)
        arguments, results = ((ctypes.c_void_p * 8)(one.ctypes.data) for one in (row, answer))
        assert called(arguments, results, None, ctypes.c_void_p(work.ctypes.data), 0) == 0
        return float(answer[0])

    good = np.array([(-1.0) ** k for k in range(size)]) * float(np.finfo(kind.type).max) / 2**28
    assert fine(good) == 1
    for k in range(size):
        for bad in (np.nan, np.inf, -np.inf):
            values = good.copy()
            values[k] = bad
            assert fine(values) == 0, (k, bad)


@needs_compiler
def test_scalar_functions_of_one_name_are_two(cache):
    """A composed Function may call several that CasADi would export under the same name."""
    x = ca.MX.sym("x", 3)
    both = ca.Function("fpirhc_both", [x], [model(2.0)(x), model(3.0)(x + model(2.0)(x))])
    at = np.array([0.3, -0.7, 2.0])
    for one, other in zip(native(both, required=True).function(at), both(at), strict=True):
        np.testing.assert_array_equal(one.full(), other.full())
