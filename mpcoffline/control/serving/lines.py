"""A device at the other end of a TCP connection that speaks one JSON object a line.

The loop asks, the device answers with the number of the question, so that a late answer is never taken for the next::

    {"id": 1, "do": "read"}                             -> {"id": 1, "values": {"T": 41.2}, "inputs": {"power": 3.0}}
    {"id": 2, "do": "write", "inputs": {"power": 2.5}}  -> {"id": 2}
    whatever goes wrong                                 -> {"id": 2, "error": "..."}
"""

from __future__ import annotations

import json
import math
import socket
import socketserver
import threading
from collections.abc import Mapping
from typing import Any, Self

from mpcoffline.core.errors import MPCOfflineError

from .device import Device, DeviceError, Measurement

_LINE = 1 << 20  # bytes of a line
_STALE = 1_000  # late answers that are read over


class LineDevice:
    """The loop's end of the connection. It connects when first asked, and again after whatever has gone wrong.

    Args:
        host: Name or address of the device.
        port: Its port.
        timeout: Seconds that it may take to connect, and to answer.
    """

    def __init__(self, host: str, port: int, timeout: float = 1.0) -> None:
        self._address, self._timeout, self._id = (host, port), timeout, 0
        self._socket: socket.socket | None = None
        self._rest = b""
        self._lock = threading.Lock()

    def read(self) -> Measurement:
        """Asks for a measurement.

        Raises:
            DeviceError: If there is no answer, or none that is one.
        """
        answer = self._ask({"do": "read"})
        return Measurement(_numbers(answer, "values"), _numbers(answer, "inputs"))

    def write(self, inputs: Mapping[str, float]) -> None:
        """Sends inputs.

        Raises:
            DeviceError: If the device does not confirm them.
        """
        self._ask({"do": "write", "inputs": dict(inputs)})

    def close(self) -> None:
        """Ends the connection; the next question begins another."""
        if self._socket is not None:
            self._socket.close()
        self._socket, self._rest = None, b""

    def _ask(self, question: dict[str, Any]) -> dict[str, Any]:
        with self._lock:
            self._id += 1
            try:
                if self._socket is None:
                    self._socket = socket.create_connection(self._address, self._timeout)
                    self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._socket.sendall(json.dumps({"id": self._id} | question).encode() + b"\n")
                for _ in range(_STALE):
                    answer = json.loads(self._line(self._socket))
                    if isinstance(answer, dict) and answer.get("id") == self._id:
                        break
                else:
                    raise ValueError("answers to other questions only")
            except (OSError, ValueError, RecursionError) as error:
                self.close()
                raise self._error("an answer", str(error) or type(error).__name__) from error
            if "error" in answer:
                raise self._error("no error", str(answer["error"])[:200])
            return answer

    def _line(self, connection: socket.socket) -> bytes:
        while b"\n" not in self._rest:
            received = connection.recv(1 << 16)
            if not received:
                raise ConnectionError("the device has closed the connection")
            self._rest += received
            if len(self._rest) > _LINE:
                raise ValueError(f"more than {_LINE} bytes without an end of line")
        line, _, self._rest = self._rest.partition(b"\n")
        return line

    def _error(self, expected: str, actual: str) -> DeviceError:
        host, port = self._address
        return DeviceError(f"device {host}:{port}", expected=expected, actual=actual[:200])


def _numbers(answer: Mapping[str, Any], name: str) -> dict[str, float]:
    """Numbers by name; null is one that is not known."""
    found = answer.get(name, {})
    if not isinstance(found, dict):
        raise DeviceError(name, expected="numbers by name", actual=repr(found)[:100])
    try:
        return {str(key): math.nan if value is None else float(value) for key, value in found.items()}
    except (TypeError, ValueError) as error:
        raise DeviceError(name, expected="numbers by name", actual=str(error)[:100]) from error


class LineServer:
    """The device's end: answers for any :class:`Device`, in a thread, until it is closed. For tests and simulations.

    It listens on this computer alone unless another address is given, and asks nobody who they are.

    Args:
        device: What is measured and moved.
        host: Address to listen on.
        port: Port; 0 for a free one.
    """

    host: str | bytes | bytearray
    port: int

    def __init__(self, device: Device, host: str = "127.0.0.1", port: int = 0) -> None:
        lock, connections = threading.Lock(), set[socket.socket]()
        self._connections = connections

        class Handler(socketserver.StreamRequestHandler):
            disable_nagle_algorithm = True

            def handle(self) -> None:
                connections.add(self.connection)
                try:
                    while line := self.rfile.readline(_LINE):
                        with lock:
                            answer = _answered(device, line)
                        self.wfile.write(json.dumps(answer).encode() + b"\n")
                except OSError:  # the other end has gone
                    pass
                finally:
                    connections.discard(self.connection)

        class Server(socketserver.ThreadingTCPServer):
            allow_reuse_address, daemon_threads, block_on_close = True, True, False

        self._server = Server((host, port), Handler)
        self.host, self.port = self._server.server_address[:2]
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.02,), daemon=True)
        self._thread.start()

    def close(self) -> None:
        """Stops, and cuts all connections, as a device that is switched off."""
        self._server.shutdown()
        self._server.server_close()
        for connection in list(self._connections):
            try:
                connection.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()


def _answered(device: Device, line: bytes) -> dict[str, Any]:
    """The answer to a line."""
    number: Any = None
    try:
        question = json.loads(line)
        number = question.get("id")
        if question.get("do") == "read":
            measured = device.read()
            return {"id": number, "values": dict(measured.values), "inputs": dict(measured.inputs)}
        if question.get("do") == "write":
            device.write({str(name): float(value) for name, value in question["inputs"].items()})
            return {"id": number}
        return {"id": number, "error": "'do' is neither 'read' nor 'write'"}
    except (MPCOfflineError, OSError, ValueError, TypeError, AttributeError, LookupError, RecursionError) as error:
        return {"id": number, "error": f"{type(error).__name__}: {error}"[:200]}
