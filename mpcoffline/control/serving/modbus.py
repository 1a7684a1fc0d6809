"""A device behind Modbus TCP, its registers by name; needs ``pip install "mpcoffline[modbus]"``."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any, Literal, cast, get_args

from mpcoffline.core.checks import check_integers, check_number
from mpcoffline.core.errors import InvalidArgumentError

from .device import DeviceError, Measurement

EXTRA = 'pip install "mpcoffline[modbus]"'

Kind = Literal["int16", "uint16", "int32", "uint32", "int64", "uint64", "float32", "float64"]
Table = Literal["holding", "input"]
_KINDS, _TABLES = get_args(Kind), get_args(Table)
_LAST = 65_535  # address
_MOST = 120  # registers that one question asks for


@dataclass(frozen=True)
class Register:
    """Where a number stands: ``value = scale * raw + offset``.

    Example:
        >>> Register(40, "int16", scale=0.1)  # tenths

    Args:
        address: Of its first register, counted from 0, as on the wire; a manual's 40001 is 0 of the table "holding".
        kind: How it is written; those longer than a register take the next ones, too.
        scale: What a step of the raw number means, in the unit of the plant file.
        offset: What is added then.
        table: ``"holding"`` registers can be written, ``"input"`` ones only read.

    Raises:
        InvalidArgumentError: For an address, kind or table that is none, or a scale of zero.
    """

    address: int
    kind: Kind = "float32"
    scale: float = 1.0
    offset: float = 0.0
    table: Table = "holding"

    def __post_init__(self) -> None:
        check_integers(0, address=self.address)
        for what, given, known in (("kind", self.kind, _KINDS), ("table", self.table, _TABLES)):
            if given not in known:
                raise InvalidArgumentError(
                    f"register: {what}", expected=f"one of {', '.join(known)}", actual=repr(given)
                )
        check_number("register: scale", self.scale, -math.inf, open_low=False)
        check_number("register: offset", self.offset, -math.inf, open_low=False)
        if self.scale == 0.0 or self.address + self.size - 1 > _LAST:
            expected = f"an address up to {_LAST} and a scale that is not zero"
            raise InvalidArgumentError("register", expected=expected, actual=repr(self))

    @property
    def size(self) -> int:
        """How many registers it takes."""
        return int(self.kind.lstrip("uintfloa")) // 16

    @property
    def limits(self) -> tuple[float, float]:
        """The least and the largest raw number."""
        bits = 16 * self.size
        if self.kind.startswith("float"):
            return -math.inf, math.inf
        return (0, 2**bits - 1) if self.kind.startswith("u") else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)


class ModbusDevice:
    """A plant behind Modbus TCP, as :class:`~mpcoffline.control.serving.Service` measures and moves it.

    It connects when first asked, and again after whatever has gone wrong. A raw number that does not fit a register
    is refused, never cut.

    Example:
        >>> device = ModbusDevice(
        ...     "192.168.0.7",
        ...     {"h1": Register(0), "h2": Register(2), "set_point": Register(4)},
        ...     {"pump": Register(100, "int16", scale=0.01)},
        ... )

    Args:
        host: Name or address.
        values: Registers of states and signals, by the names of the plant file.
        inputs: Registers of inputs, by name; they are read back, too.
        port: Its port.
        unit: Number of the unit behind a gateway.
        words: Which word of a longer number comes first.
        timeout: Seconds that it may take to connect, and to answer.

    Raises:
        InvalidArgumentError: If the package pymodbus is missing, or an input stands where nothing can be written.
    """

    def __init__(
        self,
        host: str,
        values: Mapping[str, Register],
        inputs: Mapping[str, Register],
        *,
        port: int = 502,
        unit: int = 1,
        words: Literal["big", "little"] = "big",
        timeout: float = 1.0,
    ) -> None:
        try:
            from pymodbus.client import ModbusTcpClient
        except ImportError as error:
            raise InvalidArgumentError(
                "device", expected="the package pymodbus", actual="not installed", hint=EXTRA
            ) from error
        for name, register in inputs.items():
            if register.table != "holding":
                raise InvalidArgumentError(f"input {name}", expected="a holding register", actual=register.table)
        check_number("timeout", timeout, 0.0)
        self._values, self._inputs, self._name = dict(values), dict(inputs), f"device {host}:{port}"
        self._unit, self._words = unit, words
        self._client: Any = ModbusTcpClient(host, port=port, timeout=timeout, retries=0)

    def read(self) -> Measurement:
        """Asks for all registers; those that lie together in one question.

        Raises:
            DeviceError: If there is no answer, or an error.
        """
        raw: dict[tuple[str, int], int] = {}
        for table, first, count in self._blocks():
            ask = self._client.read_holding_registers if table == "holding" else self._client.read_input_registers
            answer = self._asked(ask, first, count=count)
            raw |= {(table, first + k): word for k, word in enumerate(answer.registers)}
        values, inputs = (
            {name: self._number(each, raw) for name, each in group.items()} for group in (self._values, self._inputs)
        )
        return Measurement(values, {name: value for name, value in inputs.items() if math.isfinite(value)})

    def write(self, inputs: Mapping[str, float]) -> None:
        """Writes inputs, by name.

        Raises:
            DeviceError: If the device does not confirm, or a number does not fit its register.
        """
        for name, value in inputs.items():
            register = self._inputs[name]
            raw = (value - register.offset) / register.scale
            low, high = register.limits
            number = raw if register.kind.startswith("float") else round(raw)
            if not low <= number <= high:
                raise DeviceError(f"{self._name}: {name}", expected=f"a {register.kind}", actual=f"{raw:g}")
            words = self._client.convert_to_registers(number, self._type(register), word_order=self._words)
            self._asked(self._client.write_registers, register.address, words)

    def close(self) -> None:
        """Ends the connection; the next question begins another."""
        self._client.close()

    def _blocks(self) -> list[tuple[str, int, int]]:
        """Table, first register and how many, of the fewest questions that leave nothing out."""
        wanted = sorted((r.table, r.address, r.size) for r in (*self._values.values(), *self._inputs.values()))
        blocks: list[tuple[str, int, int]] = []
        for table, address, size in wanted:
            if blocks and blocks[-1][0] == table and address <= blocks[-1][1] + blocks[-1][2]:
                first, end = blocks[-1][1], max(blocks[-1][1] + blocks[-1][2], address + size)
                if end - first <= _MOST:
                    blocks[-1] = table, first, end - first
                    continue
            blocks.append((table, address, size))
        return blocks

    def _number(self, register: Register, raw: Mapping[tuple[str, int], int]) -> float:
        words = [raw[register.table, register.address + k] for k in range(register.size)]
        number = self._client.convert_from_registers(words, self._type(register), word_order=self._words)
        return register.scale * float(cast("float", number)) + register.offset

    def _type(self, register: Register) -> Any:
        return self._client.DATATYPE[register.kind.upper()]

    def _asked(self, ask: Any, *arguments: Any, **named: Any) -> Any:
        """The answer to a question."""
        from pymodbus.exceptions import ModbusException

        try:
            if not self._client.connected and not self._client.connect():
                raise ConnectionError("no connection")
            answer = ask(*arguments, **named, device_id=self._unit)
        except (OSError, ModbusException) as error:
            self._client.close()
            raise DeviceError(self._name, expected="an answer", actual=str(error)[:200]) from error
        if answer.isError():
            raise DeviceError(self._name, expected="no error", actual=str(answer)[:200])
        return answer
