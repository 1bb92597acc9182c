"""``escape udev``, ``doctor`` and ``discover`` on simulated computers."""

from __future__ import annotations

import os
import re
from pathlib import Path

import pytest

from escape_hw.api.emulator import EmulatorRequest
from escape_hw.config.loader import load_system
from escape_hw.runtime.host import doctor, udev
from escape_hw.runtime.host.computer import Host, route_to
from escape_hw.runtime.host.discovery import discover
from escape_sim.emulators.asm.emulator import make_emulator

RULES = (udev.find_packaged_files() / "70-escape.rules").read_text()


def put(root: Path, path: str, text: str) -> None:
    file = root / path
    file.parent.mkdir(parents=True, exist_ok=True)
    file.write_text(text + "\n")


def usb(root: Path, port: str, vendor: str, serial: str, number: int, **words: str) -> Path:
    folder = f"sys/devices/usb1/{port}"
    about = {"idVendor": vendor, "idProduct": "3001", "serial": serial, "busnum": "1", "devnum": str(number)}
    for name, text in {**about, **words}.items():
        put(root, f"{folder}/{name}", text)
    link = root / "sys/bus/usb/devices" / port
    link.parent.mkdir(parents=True, exist_ok=True)
    link.symlink_to(root / folder)
    return root / folder


@pytest.fixture
def bench(tmp_path: Path) -> Path:
    """A computer with a XIMEA, a Grasshopper3, and a serial adapter that dawdles."""
    root = tmp_path / "root"
    usb(root, "1-1", "20f7", "12345678", 4, manufacturer="XIMEA", product="MQ013MG-ON")
    usb(root, "1-2", "1e10", "19001", 5, manufacturer="Point Grey", product="Grasshopper3")
    usb(root, "1-3", "046d", "", 6, product="Mouse")
    adapter = usb(root, "1-4", "0403", "PI77", 7, manufacturer="PI", product="E-727")
    put(adapter, "1-4:1.0/ttyUSB0/uevent", "")
    put(root, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "16")
    tty = root / "sys/class/tty/ttyUSB0"
    tty.parent.mkdir(parents=True)
    tty.symlink_to(adapter / "1-4:1.0/ttyUSB0")
    put(root, "sys/module/usbcore/parameters/usbfs_memory_mb", "16")
    for cpu in range(2):
        put(root, f"sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "powersave")
    return root


def levels(root: Path, config: object = None) -> dict[str, doctor.Finding]:
    found = doctor.check_computer(config, Host(root), root)  # type: ignore[arg-type]
    return {finding.item: finding for finding in found}


# --------------------------------------------------------------------- udev
def test_rules_are_well_formed() -> None:
    """What ``udevadm verify`` of a newer systemd would say."""
    lines = [line for line in RULES.splitlines() if line and not line.startswith("#")]
    assert len(lines) >= 8
    part = r'[A-Z]+(?:\{[A-Za-z_/]+\})?(?:==|!=|\+=|=)"[^"]*"'
    for line in lines:
        assert re.fullmatch(rf"{part}(?:, {part})*", line), line
        assert "==" in line, "it would match everything"
        keys = [re.match(r"[A-Z]+", word)[0] for word in line.split(", ")]  # type: ignore[index]
        matches = [bool(re.search(r"==|!=", word)) for word in line.split(", ")]
        assert matches == sorted(matches, reverse=True) or "TEST" in keys, "assignments come last"


def test_rules_stand_before_those_that_grant_access() -> None:
    (name,) = [name for name in udev.TARGETS if name.endswith(".rules")]
    assert int(name[:2]) < 73
    for vendor in ("20f7", "1e10", "1a72", "0403"):
        lines = [line for line in RULES.splitlines() if vendor in line and "MODE" in line]
        assert lines, vendor
        for line in lines:
            assert 'MODE="0660"' in line
            assert 'TAG+="uaccess"' in line
            assert "$attr{serial}" in line
    assert 'ATTR{latency_timer}="1"' in RULES


def test_install_shows_first_and_changes_only_after_confirmation(document, escape, tmp_path: Path) -> None:
    root = tmp_path / "root"
    root.mkdir()
    code, found, err = document("udev", "install", "--root", root)
    assert (code, found["changed"], found["written"]) == (1, False, [])
    assert "use --yes" in err
    assert {file["condition"] for file in found["files"]} == {"missing"}
    assert "20f7" in found["files"][0]["difference"]
    assert not list(root.iterdir())
    assert document("udev", "show", "--root", root)[0] == 0
    code, found, _ = document("udev", "install", "--root", root, "--yes")
    assert (code, found["changed"], len(found["written"])) == (0, True, 3)
    rules = root / "etc/udev/rules.d/70-escape.rules"
    assert rules.read_text() == RULES
    assert rules.stat().st_mode & 0o777 == 0o644
    code, found, _ = document("udev", "install", "--root", root, "--yes")
    assert (code, found["changed"]) == (0, False)
    rules.write_text(RULES.replace("0660", "0666"))
    out = escape("udev", "show", "--root", root)[1]
    assert "different" in out
    assert re.search(r'^    -.*MODE="0666"', out, re.MULTILINE)


@pytest.mark.skipif(os.geteuid() == 0, reason="root may write anywhere; .ci/run runs this as another user")
def test_install_without_permission_names_the_command(escape) -> None:
    code, _, err = escape("udev", "install", "--yes")
    assert code == 1
    assert "sudo " in err


# --------------------------------------------------------------------- doctor
def test_doctor_names_what_is_wrong_and_the_remedy(bench: Path) -> None:
    found = levels(bench)
    for item, text, way in (
        ("usbfs memory", "16 MB", "usbcore.usbfs_memory_mb=1000"),
        ("latency of /dev/ttyUSB0", "16 ms on every answer of E-727", "escape udev install"),
        ("governor", "powersave", "cpupower"),
        ("udev", "70-escape.rules missing", "escape udev install"),
    ):
        assert found[item].level == "warning", item
        assert text in found[item].text
        assert way in found[item].remedy
    assert found["ALPAO SDK"].level in ("info", "ok")
    assert doctor.exit_code(list(found.values())) == 1


def test_doctor_gives_the_remedy_on_a_computer_without_usb(tmp_path: Path) -> None:
    config = load_system("razor-shwfs", overrides=["devices.wfs.mode=hardware"])
    found = levels(tmp_path, config)
    assert found["usbfs memory"].level == "error"
    assert "virtual machine" in found["usbfs memory"].remedy


def test_doctor_is_content_with_a_good_bench(bench: Path) -> None:
    put(bench, "sys/module/usbcore/parameters/usbfs_memory_mb", "1000")
    put(bench, "sys/bus/usb-serial/devices/ttyUSB0/latency_timer", "1")
    for cpu in range(2):
        put(bench, f"sys/devices/system/cpu/cpu{cpu}/cpufreq/scaling_governor", "performance")
    udev.apply_changes(udev.plan_changes(bench))
    found = levels(bench)
    for item in ("usbfs memory", "latency of /dev/ttyUSB0", "governor", "udev", "free space", "packages"):
        assert found[item].level == "ok", found[item]


def test_what_a_real_system_needs_and_lacks_is_an_error(bench: Path, monkeypatch) -> None:
    monkeypatch.setenv("ESCAPE_ALPAO_LIBRARY", "/nowhere/libasdk.so")
    config = load_system("razor-shwfs", overrides=["devices.dm.mode=hardware"])
    found = levels(bench, config)
    assert found["ALPAO SDK"].level == "error"
    assert "ESCAPE_ALPAO_LIBRARY" in found["ALPAO SDK"].remedy
    assert "XIMEA API" not in found, "its camera is a twin"
    assert doctor.exit_code(list(found.values())) == 2


def test_doctor_finds_settings_that_a_driver_refuses(bench: Path) -> None:
    words = ["devices.wfs.mode=hardware"]
    assert "devices.wfs" not in levels(bench, load_system("revolt-shwfs", overrides=words))
    for option, text in (
        ("devices.wfs.options.pixel_format=Mono10p", "devices.wfs.options.pixel_format: 'Mono10p'  must be"),
        ("devices.wfs.bit_depth=12", "bit_depth is 12, but pixel_format 'Mono10' has 10 bits"),
        ("devices.wfs.options.shfit=1", "did you mean 'shift'"),
    ):
        found = levels(bench, load_system("revolt-shwfs", overrides=[*words, option]))["devices.wfs"]
        assert found.level == "error"
        assert text in found.text


def test_doctor_finds_a_sensor_without_a_driver(bench: Path) -> None:
    found = levels(bench, load_system("maps-nir", overrides=["devices.wfs.mode=hardware"]))
    assert found["devices.wfs.driver"].level == "error"
    assert "milk-camera" in found["devices.wfs.driver"].remedy
    assert "sim-" not in found["devices.wfs.driver"].remedy
    assert "devices.wfs.driver" not in levels(bench, load_system("maps-nir"))


def test_doctor_finds_the_way_to_the_mirror(bench: Path, tmp_path: Path) -> None:
    words = ["devices.dm.mode=hardware"]
    found = levels(bench, load_system("maps-nir", overrides=words))
    assert found["network of 'asm'"].level == "ok"
    assert "127.0.0.1 by lo" in found["network of 'asm'"].text
    lost = [*words, "devices.dm.options.host=no.such.host.invalid"]
    assert levels(bench, load_system("maps-nir", overrides=lost))["network of 'asm'"].level == "error"
    put(tmp_path, "BAX1.acfg", "Itf=eth\nIP = 127.0.0.1 ;")
    alpao = [*words, "devices.dm.serial=bax1", f"devices.dm.options.config_folder={tmp_path}"]
    assert levels(bench, load_system("razor-shwfs", overrides=alpao))["network of 'alpao'"].level == "ok"


def test_doctor_reports_the_computer_it_runs_on(document, escape) -> None:
    code, found, _ = document("doctor")
    assert code == found["verdict"] in (0, 1, 2)
    items = {finding["item"]: finding for finding in found["findings"]}
    assert {"groups", "udev", "real-time priority", "locked memory", "free space", "governor"} <= set(items)
    assert all(finding["level"] in ("ok", "info", "warning", "error") for finding in items.values())
    assert escape("doctor", "no-such-system")[0] == 2


def test_a_full_disk_is_noticed(monkeypatch, tmp_path: Path) -> None:
    monkeypatch.setattr(doctor, "FREE_GB", 1e9)
    found = {f.item: f for f in doctor.check_computer(None, Host(tmp_path), tmp_path / "not/there/yet")}
    assert found["free space"].level == "warning"


def test_routes() -> None:
    assert route_to("127.0.0.1", 9) == ("127.0.0.1", "lo")
    with pytest.raises(OSError, match=r".+"):
        route_to("no.such.host.invalid", 9)


# --------------------------------------------------------------------- discover
def test_devices_are_found_with_lines_to_paste(bench: Path, monkeypatch, tmp_path: Path) -> None:
    put(tmp_path, "BAX118.acfg", "")
    monkeypatch.setenv("ACECFG", str(tmp_path))
    monkeypatch.delenv("ACEROOT", raising=False)
    found = {device.serial: device for device in discover((), Host(bench))}
    assert set(found) == {"12345678", "19001", "PI77", "BAX118"}
    camera = found["12345678"]
    assert (camera.kind, camera.model, camera.driver) == ("camera", "XIMEA MQ013MG-ON", "ximea")
    assert camera.where == "/dev/bus/usb/001/004"
    assert found["PI77"].where == "/dev/ttyUSB0"
    assert 'serial_port = "/dev/escape/serial-PI77"' in found["PI77"].toml


def test_what_is_pasted_is_a_sound_configuration(bench: Path, monkeypatch, tmp_path: Path) -> None:
    put(tmp_path, "BAX118.acfg", "")
    monkeypatch.setenv("ACECFG", str(tmp_path))
    base = (Path(load_system.__code__.co_filename).parent / "systems/razor-pywfs.toml").read_text()
    for device in discover((), Host(bench)):
        section = device.toml.splitlines()[0]
        body, pasted = base, device.toml
        for line in pasted.splitlines()[1:4]:
            key = line.split(" = ")[0]
            body = re.sub(rf"(?ms)(^{re.escape(section)}\n(?:(?!^\[).)*?)^{key} = [^\n]*\n", r"\1", body)
        head, more = "\n".join(pasted.splitlines()[:4]), "\n".join(pasted.splitlines()[4:])
        body = body.replace(section + "\n", head + "\n", 1) + "\n" + more + "\n"
        file = tmp_path / f"{device.serial}.toml"
        file.write_text(body)
        config = load_system(file)
        key = section.strip("[]").split(".")[1]
        assert getattr(config.devices, key).serial == device.serial
        assert getattr(config.devices, key).mode == "hardware"


def test_a_device_in_use_names_the_owner(bench: Path) -> None:
    device = bench / "dev/bus/usb/001/004"
    put(bench, "dev/bus/usb/001/004", "")
    put(bench, "proc/4711/comm", "xiCamTool")
    handles = bench / "proc/4711/fd"
    handles.mkdir()
    (handles / "5").symlink_to(device)
    found = {one.serial: one for one in discover((), Host(bench))}
    assert found["12345678"].in_use_by == ("xiCamTool (4711)",)
    assert found["19001"].in_use_by == ()


def test_a_library_that_is_there_is_named_by_its_file(bench: Path, monkeypatch) -> None:
    monkeypatch.setenv("ESCAPE_ALPAO_LIBRARY", "libc.so.6")
    found = levels(bench)["ALPAO SDK"]
    assert found.level == "ok"
    assert re.search(r"/libc\S*\.so", found.text)


def test_a_mirror_on_the_network_is_found_at_a_given_host(document) -> None:
    with make_emulator(EmulatorRequest(port=0)) as made:
        where = made.start().removeprefix("tcp ")
        code, found, _ = document("discover", "--host", where, "--host", "127.0.0.1:1")
    assert code == 0
    (mirror,) = [one for one in found["devices"] if one["driver"] == "asm"]
    assert mirror["serial"] == "SIM336"
    assert "emulated" in mirror["model"]
    assert f"port = {where.rpartition(':')[2]}" in mirror["toml"]
    assert "disabled = [259, 260" in mirror["toml"]


def test_missing_libraries_of_the_window_are_named(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("escape_hw.runtime.host.doctor._can_load", lambda name: "xcb-icccm" not in name)
    finding = levels(tmp_path)["window"]
    assert (finding.level, finding.text) == ("warning", "Qt misses libxcb-icccm4")
    assert finding.remedy == "apt install libxcb-icccm4"


def test_the_memory_that_programs_may_take_is_what_the_kernel_says(tmp_path: Path) -> None:
    assert Host(tmp_path).available_memory() is None
    put(tmp_path, "proc/meminfo", "MemTotal:       16000 kB\nMemAvailable:    9000 kB\n")
    assert Host(tmp_path).available_memory() == 9000 * 1024
