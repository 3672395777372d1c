"""The twin's process: the sockets of the simulated controller, around one `Machine`. Started by `TwinController`.

RTDE stream (30004), script upload (30003) and dashboard (29999), as a UR controller has them. Faults come from the
parent process, which is told the true pose.
"""

import asyncio
import contextlib
import os
import struct
import time
import traceback
from asyncio import StreamReader, StreamWriter
from collections.abc import Awaitable, Callable, Coroutine
from typing import Any

import numpy as np

from torchpose.rig.child import serve
from torchpose.rig.twin import wire
from torchpose.rig.twin.machine import Fault, Machine, Safety

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION = (5, 11, 1, 108318)
TICK_S = 0.004

Handler = Callable[[StreamReader, StreamWriter], Awaitable[None]]


class Server:
    """The controller's three sockets, and what the parent asks for (see `TwinController`); all in one event loop."""

    machine: Machine

    async def start(
        self, host: str, start_pose: list[float], errors: dict[str, float], seed: int, faults: list[str]
    ) -> None:
        """Serves from now on, the tool at a pose (mm, rad). Raises OSError where a port cannot be used."""
        self.machine = Machine(np.array(start_pose) * [1e-3, 1e-3, 1e-3, 1, 1, 1], errors, seed)
        for fault in faults:
            await self.inject(fault)
        for port, handler in ((RTDE_PORT, self.rtde), (SCRIPT_PORT, self.script), (DASHBOARD_PORT, self.dashboard)):
            await asyncio.start_server(self._guarded(handler), host, port)
        self._ticking = _run(self._tick())

    async def inject(self, fault: str, at_fraction: float | None = None) -> None:
        self.machine.inject(Fault(fault), at_fraction, time.monotonic())

    async def clear(self) -> None:
        self.machine.clear()

    async def state(self) -> dict[str, Any]:
        now = time.monotonic()
        self.machine.advance(now)
        return self.machine.state(now)

    async def _tick(self) -> None:
        while True:
            self.machine.advance(time.monotonic())
            await asyncio.sleep(TICK_S)

    def _guarded(self, handler: Handler) -> Handler:
        silent = {Fault.SILENT, Fault.SILENT_STREAM} if handler == self.rtde else {Fault.SILENT}

        async def serve(reader: StreamReader, writer: StreamWriter) -> None:
            while self.machine.faults & silent:
                await asyncio.sleep(TICK_S)
            with contextlib.suppress(ConnectionError, asyncio.IncompleteReadError):
                await handler(reader, writer)
            writer.close()

        return serve

    async def rtde(self, reader: StreamReader, writer: StreamWriter) -> None:
        """One client of the stream: recipes out and in, then data packets both ways."""
        inputs: dict[int, wire.Recipe] = {}
        output, period = wire.Recipe(1, ()), 0.008
        sender: asyncio.Task[None] | None = None
        try:
            while True:
                size, kind = wire.HEADER.unpack(await reader.readexactly(wire.HEADER.size))
                payload = await reader.readexactly(size - wire.HEADER.size)
                if kind == wire.PROTOCOL:
                    reply = b"\1"
                elif kind == wire.VERSION:
                    reply = struct.pack(">4I", *VERSION)
                elif kind == wire.OUTPUTS:
                    period = 1 / struct.unpack(">d", payload[:8])[0]
                    output = wire.Recipe(1, wire.names(payload[8:]))
                    reply = bytes([output.id]) + ",".join(output.types).encode()
                elif kind == wire.INPUTS:
                    recipe = wire.Recipe(len(inputs) + 1, wire.names(payload))
                    inputs[recipe.id] = recipe
                    types = ["IN_USE"] if Fault.REGISTERS_IN_USE in self.machine.faults else recipe.types
                    reply = bytes([recipe.id]) + ",".join(types).encode()
                elif kind in (wire.START, wire.PAUSE):
                    if sender is not None:
                        sender.cancel()
                    accepted = kind == wire.PAUSE or "NOT_FOUND" not in output.types
                    if kind == wire.START and accepted:
                        sender = _run(self._stream(writer, output, period))
                    reply = bytes([accepted])
                elif kind == wire.DATA:
                    self.machine.write(inputs[payload[0]].unpack(payload[1:]), time.monotonic())
                    continue
                else:
                    continue
                writer.write(wire.packet(kind, reply))
        finally:
            if sender is not None:
                sender.cancel()

    async def _stream(self, writer: StreamWriter, recipe: wire.Recipe, period: float) -> None:
        due = time.monotonic()
        while not writer.is_closing():
            now = time.monotonic()
            self.machine.advance(now)
            if not self.machine.faults & {Fault.STALL, Fault.SILENT}:
                writer.write(recipe.pack([self.machine.value(name, now) for name in recipe.names]))
            due = max(due + period, now)  # a loaded machine loses samples, it does not send them late in a burst
            await asyncio.sleep(due - time.monotonic())

    async def script(self, reader: StreamReader, _writer: StreamWriter) -> None:
        """Uploads: text up to a line `end` without indentation is one program."""
        text = b""
        while chunk := await reader.read(1 << 16):
            text += chunk
            if text.endswith(b"\nend\n"):
                text = b""
                await asyncio.sleep(0.02)
                self.machine.upload(time.monotonic())

    async def dashboard(self, reader: StreamReader, writer: StreamWriter) -> None:
        """The dashboard server, with the answers of the real one."""
        writer.write(b"Connected: Universal Robots Dashboard Server\n")
        while line := (await reader.readline()).decode(errors="replace"):
            if Fault.SILENT not in self.machine.faults:
                writer.write(self._answer(line.strip()).encode() + b"\n")
            if line.strip() == "quit":
                return

    def _answer(self, command: str) -> str:
        machine = self.machine
        if command == "stop":
            machine.stop_program(time.monotonic())
            return "Stopped"
        if command == "unlock protective stop":
            machine.unlocks += 1
            return "Protective stop releasing"
        answers = {
            "robotmode": f"Robotmode: {'POWER_OFF' if machine.safety is Safety.EMERGENCY_STOP else 'RUNNING'}",
            "safetystatus": f"Safetystatus: {machine.safety.value[2]}",
            "safetymode": f"Safetymode: {machine.safety.value[2]}",
            "is in remote control": str(Fault.NOT_REMOTE not in machine.faults).lower(),
            "PolyscopeVersion": f"URSoftware {'.'.join(map(str, VERSION))} (torchpose twin)",
            "get serial number": "20990000001",
            "get robot model": "UR5 torchpose twin",  # `torchpose.rig.robot` knows the twin by it
            "running": f"Program running: {str(machine.program).lower()}",
            "programState": f"{'PLAYING' if machine.program else 'STOPPED'} rtde_control",
            "quit": "Disconnected",
        }
        return answers.get(command, f"could not understand: '{command}'")


def _run(coroutine: Coroutine[Any, Any, None]) -> asyncio.Task[None]:
    """Runs beside everything else; a programming error ends the process, it must not look like a silent controller."""

    def report(task: asyncio.Task[None]) -> None:
        if not task.cancelled() and (error := task.exception()) and not isinstance(error, ConnectionError):
            traceback.print_exception(error)
            os._exit(1)

    task = asyncio.create_task(coroutine)
    task.add_done_callback(report)
    return task


async def main() -> None:
    """Serves the parent until it ends."""
    server, loop = Server(), asyncio.get_running_loop()

    def answer(request: str, **arguments: Any) -> Any:
        return asyncio.run_coroutine_threadsafe(getattr(server, request)(**arguments), loop).result()

    await asyncio.to_thread(serve, answer)
    os._exit(0)


if __name__ == "__main__":
    asyncio.run(main())
