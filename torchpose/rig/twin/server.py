"""The twin's process: the four sockets of the simulated controller. Started by `TwinController`.

RTDE stream (30004), script upload (30003), dashboard (29999), as a UR controller has them, and a side channel of JSON
lines for faults and for the true pose. The process ends when its standard input closes.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import struct
import sys
import threading
import time
import traceback
from asyncio import StreamReader, StreamWriter
from typing import Any

import numpy as np

from torchpose.rig.twin import wire
from torchpose.rig.twin.machine import Fault, Machine, Safety

RTDE_PORT, SCRIPT_PORT, DASHBOARD_PORT = 30004, 30003, 29999
VERSION = (5, 11, 1, 108318)
MODEL = "UR5 torchpose twin"  # names the twin to whoever asks the dashboard for the model
SERIAL = "20990000001"
TICK_S = 0.004


class Server:
    """Sockets around one `Machine`."""

    def __init__(self, machine: Machine) -> None:
        self.machine = machine

    async def run(self, host: str) -> None:
        """Serves until the process ends; prints one JSON line when ready."""
        handlers = {RTDE_PORT: self.rtde, SCRIPT_PORT: self.script, DASHBOARD_PORT: self.dashboard}
        servers = [await asyncio.start_server(self._guarded(h), host, port) for port, h in handlers.items()]
        side = await asyncio.start_server(self.side_channel, host, 0)
        print(json.dumps({"port": side.sockets[0].getsockname()[1]}), flush=True)
        while all(server.is_serving() for server in servers):
            self.machine.advance(time.monotonic())
            await asyncio.sleep(TICK_S)

    def _guarded(self, handler: Any) -> Any:
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
        output, period, sender = wire.Recipe(1, ()), 0.008, None
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
                    taken = Fault.REGISTERS_IN_USE in self.machine.faults
                    reply = bytes([recipe.id]) + ",".join(["IN_USE"] if taken else recipe.types).encode()
                elif kind in (wire.START, wire.PAUSE):
                    if sender is not None:
                        sender.cancel()
                    accepted = kind == wire.PAUSE or "NOT_FOUND" not in output.types
                    if kind == wire.START and accepted:
                        sender = asyncio.create_task(self._stream(writer, output, period))
                        sender.add_done_callback(_report)
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
        version = ".".join(map(str, VERSION))
        answers = {
            "robotmode": f"Robotmode: {'POWER_OFF' if machine.safety is Safety.EMERGENCY_STOP else 'RUNNING'}",
            "safetystatus": f"Safetystatus: {machine.safety.value[2]}",
            "safetymode": f"Safetymode: {machine.safety.value[2]}",
            "is in remote control": str(Fault.NOT_REMOTE not in machine.faults).lower(),
            "PolyscopeVersion": f"URSoftware {version} (torchpose twin)",
            "get serial number": SERIAL,
            "get robot model": MODEL,
            "running": f"Program running: {str(machine.program).lower()}",
            "programState": f"{'PLAYING' if machine.program else 'STOPPED'} rtde_control",
            "quit": "Disconnected",
        }
        return answers.get(command, f"could not understand: '{command}'")

    async def side_channel(self, reader: StreamReader, writer: StreamWriter) -> None:
        """``{"do": "state"}``, ``{"do": "clear"}``, ``{"do": "inject", "fault": ..., "at_fraction": ...}``."""
        while line := await reader.readline():
            request, now = json.loads(line), time.monotonic()
            if request["do"] == "inject":
                self.machine.inject(Fault(request["fault"]), request.get("at_fraction"), now)
            elif request["do"] == "clear":
                self.machine.clear()
            self.machine.advance(now)
            writer.write(json.dumps(self.machine.state(now)).encode() + b"\n")


def _report(task: asyncio.Task[None]) -> None:
    """A programming error must not look like a silent controller."""
    if not task.cancelled() and (error := task.exception()) and not isinstance(error, ConnectionError):
        traceback.print_exception(error)
        os._exit(1)


def _end_with_parent() -> None:
    sys.stdin.read()
    os._exit(0)


def main() -> None:
    """``server.py SETUP``: SETUP is JSON with host, start_pose (mm, rad), errors, seed and faults."""
    setup = json.loads(sys.argv[1])
    start = np.array(setup["start_pose"], dtype=float)
    start[:3] *= 1e-3
    machine = Machine(start, setup["errors"], setup["seed"])
    for fault in setup["faults"]:
        machine.inject(Fault(fault), None, time.monotonic())
    threading.Thread(target=_end_with_parent, daemon=True).start()
    try:
        asyncio.run(Server(machine).run(setup["host"]))
    except OSError as error:
        print(json.dumps({"error": error.strerror or str(error)}), flush=True)


if __name__ == "__main__":
    main()
