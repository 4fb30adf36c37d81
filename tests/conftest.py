"""What every test shares: how XLA compiles, the device, and JAX's 64-bit mode.

Most of a test's time is XLA compiling, so it compiles fast and loosely optimized
code here, and each program once for all worker processes. ``--optimized`` compiles
as users do; tests marked ``optimized`` are the ones for which that matters.

On a machine with an NVIDIA GPU every test runs twice, on the CPU and on the GPU;
``-m gpu`` and ``-m "not gpu"`` choose. Without a GPU, tests run on the CPU and those
that are marked ``gpu`` themselves are skipped.
"""

from __future__ import annotations

import atexit
import functools
import gc
import os
import shutil
import signal
import tempfile
from collections.abc import Iterator
from pathlib import Path
from typing import Any

# Tests run in several processes, which share the memory of a GPU. JAX reads this once.
os.environ.setdefault("XLA_PYTHON_CLIENT_PREALLOCATE", "false")

import jax
import prebuild
import pytest

FAST_COMPILING = (
    "--xla_backend_optimization_level=0",
    "--xla_llvm_disable_expensive_passes=true",
)
# JAX 0.11 has lost the first flag, and XLA ends the process where it does not know one.
# The second leaves a program whole: to compile its parts side by side costs more than
# it gains where a test runs on every core.
if jax.__version_info__ < (0, 11):
    FAST_COMPILING += ("--xla_cpu_use_fusion_emitters=false",)
    FAST_COMPILING += ("--xla_cpu_parallel_codegen_split_count=1",)

# JAX's cache of what XLA compiled keeps every program, however small.
PROGRAM_CACHE: dict[str, Any] = {
    "jax_persistent_cache_min_compile_time_secs": 0.0,
    "jax_persistent_cache_min_entry_size_bytes": -1,
}


def pytest_addoption(parser: pytest.Parser) -> None:
    """Adds ``--optimized`` and ``--fuzz-cases``."""
    parser.addoption(
        "--fuzz-cases",
        type=int,
        default=150,
        help="hostile files that tests/test_fuzz.py makes (default: 150)",
    )
    parser.addoption(
        "--optimized",
        action="store_true",
        help="let XLA optimize as it does for users; tests take three times as long",
    )


def pytest_configure(config: pytest.Config) -> None:
    """Sets what holds for the whole session, before anything is collected."""
    make_our_warnings_errors(config)
    choose_compilation(config)
    if hasattr(config, "workerinput"):
        end_without_cleaning()


def end_without_cleaning() -> None:
    """Ends this worker process before JAX frees each program, which takes seconds.

    The session has all reports by then, and does not read how the process ended.
    """
    atexit.register(os._exit, 0)


def make_our_warnings_errors(config: pytest.Config) -> None:
    """Makes warnings errors for code of ours that is not in the package."""
    root = Path(__file__).resolve().parent.parent
    folders = ("benchmarks", "docs", "examples", "tests")
    ours = [path.stem for folder in folders for path in (root / folder).glob("*.py")]
    names = "|".join([*ours, "__main__", "<string>"])
    config.addinivalue_line("filterwarnings", rf"error:::({names})\Z")


def choose_compilation(config: pytest.Config) -> None:
    """Sets how XLA compiles, here and in all processes of this session."""
    has_gpu = Path("/proc/driver/nvidia").exists()
    if not config.getoption("optimized") and not has_gpu:
        given = os.environ.get("XLA_FLAGS", "").split()
        flags = [*given, *(flag for flag in FAST_COMPILING if flag not in given)]
        os.environ["XLA_FLAGS"] = " ".join(flags)

    cache = dict(PROGRAM_CACHE)
    if "JAX_COMPILATION_CACHE_DIR" not in os.environ:
        folder = tempfile.mkdtemp(prefix="newton_qd-programs-")
        config.add_cleanup(functools.partial(shutil.rmtree, folder, True))
        cache["jax_compilation_cache_dir"] = folder
    for name, value in cache.items():
        jax.config.update(name, value)
        os.environ[name.upper()] = str(value)


@pytest.hookimpl(optionalhook=True)
def pytest_xdist_setupnodes() -> None:
    """Builds the kernels once, before every worker process would do so."""
    prebuild.main()


@functools.cache
def gpu_available() -> bool:
    """Whether JAX sees an NVIDIA GPU."""
    try:
        return bool(jax.devices("gpu"))
    except RuntimeError:
        return False


def pytest_generate_tests(metafunc: pytest.Metafunc) -> None:
    """Run every test on every device of this machine."""
    if not gpu_available():
        return
    only_gpu = metafunc.definition.get_closest_marker("gpu") is not None
    gpu = pytest.param("gpu", marks=pytest.mark.gpu)
    metafunc.parametrize(
        "device", [gpu] if only_gpu else ["cpu", gpu], indirect=True, scope="session"
    )


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Skip what needs a GPU where there is none."""
    if gpu_available():
        return
    for item in items:
        if item.get_closest_marker("gpu") is not None:
            item.add_marker(pytest.mark.skip(reason="no NVIDIA GPU on this machine"))


def pytest_collection() -> None:
    """Leaves garbage alone: each look at it makes JAX look as well."""
    gc.disable()


def pytest_collection_finish() -> None:
    """Looks for garbage less often: modules and what JAX traced are never garbage."""
    gc.collect()
    gc.freeze()
    gc.set_threshold(50_000, 20, 50)
    gc.enable()


def pytest_sessionfinish() -> None:
    """Looks for garbage once: what is left now costs pytest's own looks nothing."""
    gc.collect()
    gc.freeze()


@pytest.fixture(scope="session", autouse=True)
def device(request: pytest.FixtureRequest) -> Iterator[Any]:
    """JAX device that the test runs on; arrays and jitted code go there."""
    chosen = jax.devices(getattr(request, "param", "cpu"))[0]
    with jax.default_device(chosen):
        yield chosen


@pytest.fixture
def x64() -> Iterator[None]:
    """JAX's 64-bit mode, for this test alone."""
    with jax.enable_x64(True):
        yield


@pytest.fixture(scope="session")
def newton_without_adjoints() -> Iterator[None]:
    """Newton's own kinematics compiles faster: without adjoints and optimization.

    For the rest of the session, nothing goes backwards through it.
    """
    import inspect

    import newton
    import warp as wp

    module = inspect.getmodule(newton.eval_fk)
    faster = {"enable_backward": False, "optimization_level": 0}
    before = {name: wp.get_module_options(module)[name] for name in faster}
    wp.set_module_options(faster, module)
    yield
    wp.set_module_options(before, module)


@pytest.fixture(scope="session")
def sigint() -> None:
    """SIGINT is not ignored, neither here nor in the processes that the test starts.

    A process that was started in the background may have inherited that it is, and
    hands that on.
    """
    if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
        signal.signal(signal.SIGINT, signal.default_int_handler)


@pytest.fixture
def no_network(monkeypatch: pytest.MonkeyPatch) -> None:
    """Every request into a network is an error that nobody expects."""

    def refuse(*arguments: object, **options: object) -> None:
        raise AssertionError(f"a request: {arguments}")

    for name in ("socket.connect", "socket.connect_ex", "socket.sendto"):
        monkeypatch.setattr(f"socket.{name}", refuse)
    monkeypatch.setattr("socket.getaddrinfo", refuse)


@pytest.fixture
def modules_of_qdax() -> Iterator[None]:
    """The modules that QDax has dropped."""
    import newton_qd.compat

    newton_qd.compat.install()
    yield
    newton_qd.compat.uninstall()
