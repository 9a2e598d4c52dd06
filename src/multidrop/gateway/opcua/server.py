"""An OPC UA server on asyncua, with limits for clients that are greedy, hostile or do not read.

A client of asyncua's own server could make it use unlimited memory and time. Each limit below prevents one
such case.
"""

from __future__ import annotations

import asyncio
import logging
import secrets
import socket
from collections.abc import Awaitable, Callable
from contextlib import suppress
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from typing import Any, NamedTuple

from asyncua import Server, ua
from asyncua.common.connection import TransportLimits
from asyncua.common.utils import ServiceError
from asyncua.crypto.permission_rules import SimpleRoleRuleset, User, UserRole
from asyncua.server.binary_server_asyncio import BinaryServer, OPCUAProtocol
from asyncua.server.internal_server import InternalServer
from asyncua.server.internal_session import InternalSession
from asyncua.server.monitored_item_service import MonitoredItemService
from asyncua.server.user_managers import UserManager
from cryptography import x509
from cryptography.exceptions import UnsupportedAlgorithm
from cryptography.hazmat.primitives.asymmetric.rsa import RSAPrivateKey
from cryptography.hazmat.primitives.serialization import load_pem_private_key

from multidrop.gateway.http.rights import Right

PRODUCT, NAMESPACE = "urn:multidrop", "urn:multidrop:plant"
CHUNK = 65_535  # limit of a chunk of a message, in bytes
MOST_REQUEST = 1 << 18  # limit of a request in bytes
MOST_UNREAD = 1 << 23  # a client is disconnected if it leaves more than this many bytes unread
MOST_CLIENTS = 64
MOST_WAITING = 64  # a client is disconnected if more than this many of its requests wait
MOST_OPERATIONS = 1000  # limit of nodes in one request
MOST_ITEMS = 20_000  # limit of subscribed values of all clients together
# limit of notifications of one value that wait to be sent; at the limit, a new one replaces the oldest
MOST_QUEUED = 10
# limits, in ms, of a subscription's publishing interval
LEAST_INTERVAL_MS, MOST_INTERVAL_MS = 50.0, 3_600_000.0
SESSION_MS = 60_000.0  # limit of a session's timeout, in ms
LOGIN_S = 10.0  # time limit, in s, from a client's connection to the opening of its session

POLICIES = (
    ua.SecurityPolicyType.Basic256Sha256_SignAndEncrypt,
    ua.SecurityPolicyType.Aes128Sha256RsaOaep_SignAndEncrypt,
    ua.SecurityPolicyType.Aes256Sha256RsaPss_SignAndEncrypt,
)


def _service(name: str) -> ua.NodeId:
    """Return the id of a service's requests."""
    return ua.NodeId(getattr(ua.ObjectIds, f"{name}Request_Encoding_DefaultBinary"))


CALL = _service("Call")
SERVICES = frozenset(
    _service(name)
    for name in (
        *("Read", "Browse", "BrowseNext", "TranslateBrowsePathsToNodeIds"),
        *("RegisterNodes", "UnregisterNodes"),
        *("CreateSubscription", "ModifySubscription", "DeleteSubscriptions", "SetPublishingMode"),
        *("CreateMonitoredItems", "ModifyMonitoredItems", "DeleteMonitoredItems", "SetMonitoringMode"),
        *("Publish", "Republish", "Call", "CreateSession", "ActivateSession", "CloseSession"),
        *("GetEndpoints", "FindServers", "CloseSecureChannel"),
    )
)
OPERATION_LIMITS = (
    *("MaxNodesPerRead", "MaxNodesPerBrowse", "MaxNodesPerMethodCall"),
    *("MaxNodesPerTranslateBrowsePathsToNodeIds", "MaxMonitoredItemsPerCall"),
)

# asyncua logs each invalid message with a traceback. Hostile clients could fill the log with them.
logging.getLogger("asyncua").setLevel(logging.CRITICAL)


@dataclass
class Visitor(User):
    """The user of a session: the client's address, and the token that the client gave as its password."""

    role: UserRole = UserRole.User
    address: str = ""
    secret: str = field(default="", repr=False)


HasRight = Callable[[Visitor, Right], bool]  # a function that returns whether the user has a right
# a function that handles the call of an OPC UA method; all methods of this server are stops
Stop = Callable[[ua.CallMethodRequest, Visitor], Awaitable[ua.CallMethodResult]]


class _Admission(UserManager, SimpleRoleRuleset):
    """Admits users at login, and again at each request, because a reload may have revoked their token."""

    def __init__(self, may: HasRight) -> None:
        super().__init__()
        self.address = ""  # address of the client that is logging in
        self._may = may

    def get_user(
        self,
        iserver: InternalServer,
        username: str | None = None,
        password: Any = None,
        certificate: Any = None,
    ) -> Visitor | None:
        visitor = Visitor(name=username, address=self.address, secret=str(password or ""))
        return visitor if self._may(visitor, Right.LOOK) or self._may(visitor, Right.STOP) else None

    def check_validity(self, user: Visitor, action_type_id: ua.NodeId, body: Any) -> bool:
        may_stop = action_type_id == CALL and self._may(user, Right.STOP)
        return may_stop or (action_type_id in SERVICES and self._may(user, Right.LOOK))


class _Items(MonitoredItemService):
    """The subscribed values of one subscription.

    Without a filter by deadband, it sends a value three times as fast as asyncua's class.
    """

    async def datachange_callback(self, handle: int, value: Any, error: Any = None) -> None:
        item = self._monitored_items[self._monitored_datachange[handle]]
        given = item.filter
        is_usual = not given or (
            isinstance(given, ua.DataChangeFilter)
            and given.Trigger == ua.DataChangeTrigger.StatusValue
            and given.DeadbandType == ua.DeadbandType.None_
        )
        if error is not None or not is_usual or item.mode == ua.MonitoringMode.Disabled:
            await super().datachange_callback(handle, value, error)
            return
        before, item.mvalue.current_dvalue = item.mvalue.current_dvalue, value
        if before is None or before.Value.Value != value.Value.Value or before.StatusCode != value.StatusCode:
            notification = ua.MonitoredItemNotification(item.client_handle, value)
            await self.isub.enqueue_datachange_event(item.monitored_item_id, notification, item.queue_size)


class _ClientSession(InternalSession):
    """A client's session, with limits.

    Its authentication token is random, because a client that guessed it could take over the session.
    """

    def __init__(self, server: _Internal, *arguments: Any, **more: Any) -> None:
        super().__init__(server, *arguments, **more)
        self._server = server
        if self.external:
            server.unregister_external_session(self)
            self.auth_token = ua.NodeId(secrets.token_bytes(32), 0, ua.NodeIdType.ByteString)
            server.register_external_session(self)

    def activate_session(self, params: Any, peer_certificate: bytes | None) -> Any:
        if self._server.certificate is not None and not peer_certificate:
            # without this check, asyncua would accept a channel without security
            raise ServiceError(ua.StatusCodes.BadSecurityModeRejected)
        self._server.admission.address = str(self.name[0])
        return super().activate_session(params, peer_certificate)

    async def read(self, params: Any) -> Any:
        if self.external:
            _check_count(params.NodesToRead)
        return await super().read(params)

    async def browse(self, params: Any) -> Any:
        _check_count(params.NodesToBrowse)
        found: list[Any] = []
        wanted = params.NodesToBrowse
        for params.NodesToBrowse in ([one] for one in wanted):
            found += await super().browse(params)
            await asyncio.sleep(0)  # let other tasks run, because a client may have sent a stop
        return found

    async def translate_browsepaths_to_nodeids(self, params: Any) -> Any:
        _check_count(params)
        found: list[Any] = []
        for one in params:
            found += await super().translate_browsepaths_to_nodeids([one])
            await asyncio.sleep(0)
        return found

    async def create_subscription(self, params: Any, *callbacks: Any, **more: Any) -> Any:
        wanted = params.RequestedPublishingInterval
        params.RequestedPublishingInterval = min(max(LEAST_INTERVAL_MS, wanted), MOST_INTERVAL_MS)
        found = await super().create_subscription(params, *callbacks, **more)
        subscription = self.subscription_service.subscriptions[found.SubscriptionId]
        subscription.monitored_item_srv = _Items(subscription, self.aspace)
        return found

    async def create_monitored_items(self, params: Any) -> Any:
        _check_count(params.ItemsToCreate)
        if self._server.items + len(params.ItemsToCreate) > MOST_ITEMS:
            raise ServiceError(ua.StatusCodes.BadTooManyMonitoredItems)
        return await super().create_monitored_items(params)

    async def modify_monitored_items(self, params: Any) -> Any:
        for item in params.ItemsToModify:
            wanted = item.RequestedParameters.QueueSize
            item.RequestedParameters.QueueSize = min(wanted or MOST_QUEUED, MOST_QUEUED)
        return await super().modify_monitored_items(params)

    async def call(self, params: Any) -> Any:
        _check_count(params)
        return await asyncio.gather(*(self._server.stop_method(one, self.user) for one in params))


def _check_count(operations: Any) -> None:
    if len(operations or ()) > MOST_OPERATIONS:
        raise ServiceError(ua.StatusCodes.BadTooManyOperations)


class _Internal(InternalServer):
    """asyncua's server without its network connections. It limits sessions, subscriptions and queues."""

    def __init__(self, may: HasRight, stop: Stop) -> None:
        self.admission = _Admission(may)
        super().__init__(user_manager=self.admission)
        self.stop_method = stop
        self.supported_tokens = (ua.AnonymousIdentityToken, ua.UserNameIdentityToken)
        self.max_connections = self.max_subscriptions = MOST_CLIENTS
        self.max_pending_activation_seconds = LOGIN_S
        self.max_session_timeout_ms = SESSION_MS
        self.max_monitored_item_queue_size = self.max_unacked_messages_per_subscription = MOST_QUEUED
        self.max_pending_messages_per_connection = MOST_WAITING

    def create_session(self, name: Any, user: User | None = None, external: bool = False) -> InternalSession:
        unused = [one for one in self._external_sessions.values() if not one.is_activated()]
        if len(self._external_sessions) >= 2 * MOST_CLIENTS:
            if not unused:
                raise ServiceError(ua.StatusCodes.BadTooManySessions)
            self.unregister_external_session(unused[0])
        return _ClientSession(
            self, self.aspace, self.subscription_service, name, user=user or Visitor(), external=external
        )

    def register_server(self, server: Any, conf: Any = None) -> None:
        # asyncua would store every server address that clients send in this request
        raise ServiceError(ua.StatusCodes.BadServiceUnsupported)

    @property
    def items(self) -> int:
        there = self.subscription_service.subscriptions.values()
        return sum(len(one.monitored_item_srv._monitored_items) for one in there)


class _Protocol(OPCUAProtocol):
    """A client's connection. It ends if the client sends an endless message or does not read."""

    def connection_made(self, transport: Any) -> None:
        transport.set_write_buffer_limits(high=MOST_UNREAD)
        super().connection_made(transport)

    def pause_writing(self) -> None:
        self._abort()

    def data_received(self, data: bytes) -> None:
        super().data_received(data)
        if len(self._buffer) > CHUNK:
            self._abort()

    def _abort(self) -> None:
        if self.transport is not None:
            self.transport.abort()

    async def _process_one_msg(self, header: Any, buf: Any) -> bool:
        await asyncio.sleep(0)  # process messages of other clients before this client's next one
        return bool(await super()._process_one_msg(header, buf))


class _Network(BinaryServer):
    """The network connections of the server, on a given listening socket."""

    def __init__(self, server: InternalServer, listener: socket.socket, limits: TransportLimits) -> None:
        super().__init__(server, *listener.getsockname()[:2], limits)
        self._listener = listener

    def _make_protocol(self) -> OPCUAProtocol:
        return _Protocol(self.iserver, self._policies, self.clients, self.closing_tasks, self.limits)

    async def start(self) -> None:
        loop = asyncio.get_running_loop()
        self._server = await loop.create_server(self._make_protocol, sock=self._listener)
        self.cleanup_task = asyncio.create_task(self._close_task_loop())


class Identity(NamedTuple):
    """A server's certificate and key, and the application's URI in the certificate ("" if it has none)."""

    certificate: x509.Certificate
    key: RSAPrivateKey
    uri: str


def read_identity(certificate: Path, key: Path) -> Identity:
    """Read a certificate and its key from PEM files.

    Raises ValueError for an unsuitable pair, OSError for an unreadable file.
    """
    secret: Any = None
    # the library raises TypeError if the key has a password
    with suppress(ValueError, TypeError, UnsupportedAlgorithm):
        found = x509.load_pem_x509_certificate(certificate.read_bytes())
        secret = load_pem_private_key(key.read_bytes(), None)
    if not isinstance(secret, RSAPrivateKey) or secret.public_key() != found.public_key():
        raise ValueError(
            f"certificate {certificate} and key {key} must be an RSA certificate and its key, in PEM and "
            f"without password"
        )
    names: list[str] = []
    with suppress(x509.ExtensionNotFound):
        others = found.extensions.get_extension_for_class(x509.SubjectAlternativeName).value
        names = others.get_values_for_type(x509.UniformResourceIdentifier)
    return Identity(found, secret, next(iter(names), ""))


class PlantServer(Server):
    """The OPC UA server.

    `may` returns whether a user has a right. `stop` handles method calls; all methods are stops.
    """

    def __init__(self, listener: socket.socket, may: HasRight, stop: Stop) -> None:
        self.internal = _Internal(may, stop)
        super().__init__(iserver=self.internal)
        self._listener = listener
        self.limits = TransportLimits(CHUNK, CHUNK, MOST_REQUEST // CHUNK + 1, MOST_REQUEST)

    async def open(self, version: str, identity: Identity | None) -> None:
        """Prepare the server and its address space. Without `identity`, connections are not encrypted."""
        policies, uri = [ua.SecurityPolicyType.NoSecurity], ""
        if identity is not None:
            policies, uri = [*POLICIES], identity.uri
            self.internal.certificate, self.internal.private_key = identity.certificate, identity.key
        self.set_security_policy(policies, self.internal.admission)
        host, port = self._listener.getsockname()[:2]
        self.set_endpoint(f"opc.tcp://{f'[{host}]' if ':' in host else host}:{port}/")
        self.name = "multidrop"
        await self.init()
        await self.set_application_uri(uri or f"urn:{socket.gethostname()}:multidrop")
        # gets the index 2, because a server has two namespaces already
        await self.register_namespace(NAMESPACE)
        await self.set_build_info(PRODUCT, "multidrop", "multidrop", version, "", datetime.now(UTC))
        for name in OPERATION_LIMITS:
            node = getattr(ua.ObjectIds, f"Server_ServerCapabilities_OperationLimits_{name}")
            await self.get_node(node).write_value(MOST_OPERATIONS, ua.VariantType.UInt32)

    async def start(self) -> None:
        await self._setup_server_nodes()
        await self.iserver.start()
        self.bserver = _Network(self.iserver, self._listener, self.limits)
        self.bserver.set_policies(self._policies)
        await self.bserver.start()

    async def stop(self) -> None:
        """Disconnect all clients, even those that do not read, and remove all nodes.

        The nodes are removed one by one. If the garbage collector freed them, it would stop all threads for
        0.2 s.
        """
        for transport in [*self.iserver.asyncio_transports]:
            transport.abort()
        await super().stop()
        for node in [*self.internal.aspace.keys()]:
            del self.internal.aspace[node]
