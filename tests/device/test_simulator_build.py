"""How the simulated device's program is made, and what is said where it cannot be."""

import os
import subprocess
import sys
from types import SimpleNamespace

import pytest
from simulated import ENVIRONMENT, needs_device, own_cache  # noqa: F401

from hilbo.device.local import compiled, simulator
from hilbo.hardware_bridge import DeviceError, Renderer

pytestmark = needs_device


def test_without_a_compiler_there_is_one_sentence(monkeypatch):
    monkeypatch.setenv("PATH", "")
    monkeypatch.delenv("CC", raising=False)
    with pytest.raises(DeviceError, match="there is no C compiler; install one"):
        Renderer.open("sim")


def test_without_pseudo_terminals_there_is_one_sentence(monkeypatch):
    monkeypatch.setattr(simulator.os, "name", "nt")
    with pytest.raises(DeviceError, match="no pseudo-terminals for the simulated device; use WSL"):
        simulator.built()


def test_a_cache_that_cannot_be_written_is_one_sentence(monkeypatch, tmp_path):
    (tmp_path / "file").write_text("")
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path / "file"))
    with pytest.raises(DeviceError, match="set XDG_CACHE_HOME to another folder"):
        simulator.built()


def test_sources_that_do_not_compile_are_one_sentence(monkeypatch, tmp_path):
    (tmp_path / "core").mkdir()
    (tmp_path / "core" / "broken.c").write_text("int main(void) { return nothing; }\n")
    monkeypatch.setattr(compiled, "_sources", lambda _: tmp_path)
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    with pytest.raises(DeviceError, match=r"does not compile with .*: .*broken\.c"):
        simulator.built()
    assert not list(tmp_path.glob("hilbo/*/*"))


@pytest.mark.parametrize("which", ["folder", "program"])
@pytest.mark.parametrize("how", ["writable", "link", "another user's"])
def test_a_build_that_others_may_change_is_not_run(monkeypatch, tmp_path, which, how):
    folder = tmp_path / "hilbo" / "device-0"
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    monkeypatch.setattr(compiled, "hashlib", SimpleNamespace(sha256=lambda _: Zero()))
    folder.mkdir(parents=True, mode=0o700)
    (folder / "hilbo-device").touch(0o700)
    assert simulator.built() == folder / "hilbo-device"
    path = folder if which == "folder" else folder / "hilbo-device"
    if how == "writable":
        path.chmod(0o720)
    elif how == "link":
        path.symlink_to(path.rename(tmp_path / "elsewhere"))
    else:
        monkeypatch.setattr(os, "geteuid", lambda: 12345)
    with pytest.raises(DeviceError, match="may be changed by, another user; delete it"):
        simulator.built()


class Zero:
    """A digest of nothing, so that the place of a build is known."""

    def update(self, _):
        pass

    def hexdigest(self):
        return "0"


@pytest.mark.deep
def test_two_that_build_at_once_do_no_harm(monkeypatch, tmp_path):
    monkeypatch.setenv("XDG_CACHE_HOME", str(tmp_path))
    code = "from hilbo.device.local.simulator import built; print(built())"
    env = ENVIRONMENT | {"XDG_CACHE_HOME": str(tmp_path)}
    both = [subprocess.Popen([sys.executable, "-c", code], stdout=subprocess.PIPE, text=True, env=env) for _ in "ab"]
    said = {process.communicate()[0].strip() for process in both}
    assert len(said) == 1 and [process.returncode for process in both] == [0, 0]
    assert [path.name for path in tmp_path.glob("hilbo/*/*")] == ["hilbo-device"]
