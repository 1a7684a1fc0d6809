"""A simulated plant behind pymodbus's own server on this computer, measured and moved by the loop."""

from __future__ import annotations

import asyncio
import struct
import threading
from collections.abc import Iterator
from typing import Any

import numpy as np
import pytest
from planted_logs import heater

from mpcoffline import InvalidArgumentError, MPCPolicy
from mpcoffline.control.serving import DeviceError, Service, SimulatedDevice, VirtualClock

pytest.importorskip("pymodbus.simulator")

from pymodbus.server import ModbusTcpServer
from pymodbus.simulator import DataType, SimData, SimDevice

from mpcoffline.control.serving.modbus import ModbusDevice, Register

DT = 5.0


class Plain:
    """A server with registers of any content; it runs in a thread until it is closed."""

    def __init__(self) -> None:
        self.registers = [0] * 200
        self._loop = asyncio.new_event_loop()
        self._ready = threading.Event()
        self._thread = threading.Thread(target=self._run, daemon=True)
        self._thread.start()
        assert self._ready.wait(10.0)

    def _run(self) -> None:
        asyncio.set_event_loop(self._loop)
        self._loop.run_until_complete(self._serve())

    async def _serve(self) -> None:
        async def asked(
            code: int, start: int, address: int, count: int, shown: list[int], written: list[int] | None
        ) -> None:
            if written is not None:
                self.registers[address : address + count] = written
            shown[:] = self.registers

        data = SimData(0, count=len(self.registers), values=0, datatype=DataType.REGISTERS)
        self.server = ModbusTcpServer(SimDevice(1, [data], action=asked), address=("127.0.0.1", 0))
        await self.server.serve_forever(background=True)
        self.port = self.server.transport.sockets[0].getsockname()[1]
        self._ended = asyncio.Event()
        self._ready.set()
        await self._ended.wait()
        await self.server.shutdown()

    def close(self) -> None:
        if self._thread.is_alive():
            self._loop.call_soon_threadsafe(self._ended.set)
            self._thread.join(10.0)

    def floats(self, address: int, *values: float) -> None:
        """As IEEE 754 writes them, the more significant word first."""
        self.words(address, *struct.unpack(f">{2 * len(values)}H", struct.pack(f">{len(values)}f", *values)))

    def words(self, address: int, *words: int) -> None:
        self.registers[address : address + len(words)] = words


@pytest.fixture
def server() -> Iterator[Plain]:
    running = Plain()
    yield running
    running.close()


def test_numbers_are_read_as_they_stand_in_the_registers(server: Plain) -> None:
    server.floats(0, 41.25, -3.5)
    server.words(10, 65_536 - 123)  # -123 in two's complement
    server.words(20, 1, 2)  # 65538
    values = {
        "a": Register(0), "b": Register(2, scale=2.0, offset=1.0), "c": Register(10, "int16", scale=0.1),
        "d": Register(20, "uint32"), "e": Register(0, table="input"),
    }  # fmt: skip
    device = ModbusDevice("127.0.0.1", values, {"u": Register(30, "int16", scale=0.01)}, port=server.port)
    device.write({"u": -2.5})
    assert server.registers[30] == 65_536 - 250
    measured = device.read()
    assert measured.values == pytest.approx({"a": 41.25, "b": -6.0, "c": -12.3, "d": 65_538.0, "e": 41.25})
    assert measured.inputs == pytest.approx({"u": -2.5})
    with pytest.raises(DeviceError, match="int16"):
        device.write({"u": 1000.0})
    device.close()


def test_what_does_not_answer_is_a_device_error_and_it_connects_again(server: Plain) -> None:
    device = ModbusDevice("127.0.0.1", {"a": Register(0)}, {}, port=server.port, timeout=5.0)
    server.floats(0, 1.0)
    device.close()
    assert device.read().values == {"a": 1.0}
    beyond = ModbusDevice("127.0.0.1", {"a": Register(5_000)}, {}, port=server.port, timeout=5.0)
    with pytest.raises(DeviceError, match="no error"):
        beyond.read()
    server.close()
    with pytest.raises(DeviceError, match="an answer"):
        device.read()


@pytest.mark.parametrize(
    ("wrong", "said"),
    [
        (lambda: Register(-1), "address"),
        (lambda: Register(65_535), "65535"),
        (lambda: Register(0, "int8"), "kind"),  # type: ignore[arg-type]
        (lambda: Register(0, scale=0.0), "scale"),
        (lambda: Register(0, table="coils"), "table"),  # type: ignore[arg-type]
        (lambda: ModbusDevice("h", {}, {"u": Register(0, table="input")}), "holding"),
    ],
)
def test_what_is_no_register_is_refused(wrong: Any, said: str) -> None:
    with pytest.raises(InvalidArgumentError, match=said):
        wrong()


def test_the_loop_controls_a_plant_behind_modbus_as_it_does_without(server: Plain) -> None:
    """The plant stands beside the server and moves between two periods; float32 registers round what is seen."""
    policy = MPCPolicy(heater().mpc())
    names = [label.name for label in policy.mpc.layout.y_labels]
    assert [label.name for label in policy.mpc.layout.u_labels] == ["power"]

    class Wired(ModbusDevice):
        """Its registers are those of the plant's electronics."""

        def read(self) -> Any:
            server.floats(0, *(plant.read().values[name] for name in names))
            return super().read()

        def write(self, inputs: Any) -> None:
            super().write(inputs)
            (power,) = struct.unpack(">f", struct.pack(">2H", *server.registers[100:102]))
            plant.write({"power": power})

    applied = []
    for behind in (False, True):
        clock = VirtualClock(0.0)
        plant = SimulatedDevice(heater().env(), policy.mpc, clock, seed=3)
        registers = {name: Register(2 * i) for i, name in enumerate(names)}
        device = Wired("127.0.0.1", registers, {"power": Register(100)}, port=server.port) if behind else plant
        server.floats(100, plant.read().inputs["power"])
        written: list[float] = []
        write = device.write
        device.write = lambda inputs, write=write, to=written: (to.append(inputs["power"]), write(inputs))  # type: ignore[method-assign, assignment, misc]
        stats = Service(policy, device, period=DT, clock=clock).run(30)
        assert stats.decided == 30
        applied.append(written)
    np.testing.assert_allclose(applied[1], applied[0], atol=1e-3)
