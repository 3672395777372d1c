"""Rows over OPC UA: the latest of each target as the variables of an object.

    Objects
      torchpose                     ns=2;s=torchpose
        <target>                    ns=2;s=torchpose/<target>
          frame, status, reason     String; reason is "" where there is none
          tx, ty, tz                Double, mm; NaN where there is no pose
          rx, ry, rz                Double, rotation vector, rad
          sx ... srz                Double, standard deviations of everything
          nx ... nrz                Double, of the noise alone
          rms_px                    Double
          markers                   Int64
          count                     Int64, rows of this target so far: a gap of more than one tells of rows that were
                                    not written, as the server keeps up with the latest only
          row                       String, the whole row as JSON: the one variable whose parts belong together for sure

All are for reading alone. Variables of a row carry one source timestamp, the time at which the row was handed over.
With several instances of a target in a frame these are those of instance 0; ``row`` is a list of the rows of all. Where
there is a token it is the password of the user ``torchpose``; it goes over the wire as it is: keep to a network of the
cell's own.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections.abc import Sequence
from datetime import UTC, datetime
from typing import Any

from torchpose.io.feeds.thread import Feed, Place
from torchpose.io.rows import POSE, STD, Row, Schema

NAMESPACE = "urn:torchpose"
_TEXTS = ("frame", "status", "reason")
_NUMBERS = (*POSE, *STD, *(f"n{column[1:]}" for column in STD), "rms_px")
_COUNTS = ("markers", "count")


class OpcUaFeed(Feed):
    """Serves the latest rows at ``opc.tcp://host:port/torchpose``.

    Args:
        place: where to listen.
        targets: names of the targets that have rows.
        schema: columns of the rows.
    """

    option = "--opcua"

    def __init__(self, place: Place, *, targets: Sequence[str], schema: Schema) -> None:
        super().__init__(place)
        self._targets, self._schema = list(targets), schema
        self._latest: dict[str, tuple[datetime, list[Row]]] = {}
        self._counts = dict.fromkeys(targets, 0)
        self._some = asyncio.Event()

    def _take(self, rows: Sequence[Row]) -> None:
        now = datetime.now(UTC)
        for row in rows:
            target = row["target"]
            self._counts[target] += 1
            _, others = self._latest.get(target, (now, []))
            same = [other for other in others if other["frame"] == row["frame"]]
            self._latest[target] = now, [*same, row]
        self._some.set()

    async def _serve(self) -> None:
        from asyncua import ua as types
        from asyncua.server.server import Server

        logging.getLogger("asyncua").setLevel(logging.CRITICAL)  # of a client that goes away it writes pages
        server = Server(user_manager=_users(self._place))
        await server.init()
        server.set_endpoint(f"opc.tcp://{self._place.host}:{self._place.port}/torchpose")
        server.set_server_name("torchpose")
        if self._place.token:
            server.set_identity_tokens([types.UserNameIdentityToken])
        variables = await self._made(server)
        async with server:
            self._ready()
            while not self._stopped.is_set():
                some, end = (asyncio.ensure_future(event.wait()) for event in (self._some, self._stopped))
                await asyncio.wait({some, end}, return_when=asyncio.FIRST_COMPLETED)
                some.cancel()
                end.cancel()
                self._some.clear()
                latest, self._latest = self._latest, {}
                for target, (when, rows) in latest.items():
                    await self._write(variables[target], target, when, rows)

    async def _made(self, server: Any) -> dict[str, dict[str, Any]]:
        """The variables of each target."""
        from asyncua import ua as types

        ua: Any = types
        space = await server.register_namespace(NAMESPACE)
        names = ua.NodeId("torchpose", space), ua.QualifiedName("torchpose", space)
        root = await server.nodes.objects.add_object(*names)
        starts: dict[str, Any] = dict.fromkeys((*_TEXTS, "row"), ("", ua.VariantType.String))
        starts |= dict.fromkeys(_NUMBERS, (float("nan"), ua.VariantType.Double))
        starts |= dict.fromkeys(_COUNTS, (0, ua.VariantType.Int64))
        made: dict[str, dict[str, Any]] = {}
        for target in self._targets:
            path = f"torchpose/{target}"
            thing = await root.add_object(ua.NodeId(path, space), ua.QualifiedName(target, space))
            made[target] = {
                name: await thing.add_variable(
                    ua.NodeId(f"{path}/{name}", space), ua.QualifiedName(name, space), start, kind
                )
                for name, (start, kind) in starts.items()
            }
        return made

    async def _write(self, variables: dict[str, Any], target: str, when: datetime, rows: list[Row]) -> None:
        from asyncua import ua as types

        ua: Any = types
        row = rows[0]
        given = [{column: one.get(column) for column in self._schema} for one in rows]
        values: dict[str, Any] = {name: (row[name] or "", ua.VariantType.String) for name in _TEXTS}
        values["row"] = json.dumps(given[0] if len(given) == 1 else given), ua.VariantType.String
        for name in _NUMBERS:
            values[name] = float("nan") if row[name] is None else row[name], ua.VariantType.Double
        values["markers"] = row["markers"], ua.VariantType.Int64
        values["count"] = self._counts[target], ua.VariantType.Int64  # last: who waits for it finds the rest
        for name, (value, kind) in values.items():
            await variables[name].write_value(ua.DataValue(ua.Variant(value, kind), SourceTimestamp=when))


def _users(place: Place) -> Any:
    """Lets in who knows the token, to read; asyncua's own would let anybody write who calls himself admin."""
    from asyncua.crypto.permission_rules import User, UserRole
    from asyncua.server.user_managers import UserManager

    class Users(UserManager):  # type: ignore[misc,unused-ignore]  # where asyncua is not installed
        def get_user(
            self, iserver: Any, username: str | None = None, password: str | None = None, certificate: Any = None
        ) -> User | None:
            known = not place.token or (username == "torchpose" and place.admits(password))
            return User(role=UserRole.User) if known else None

    return Users()
