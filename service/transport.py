"""HTTP as the client uses it: patient with a busy service, and every refusal a typed error.

Every request of this API may be repeated, since uploads and questions are named by their content. So while
the service is full, or its Redis is away, a request waits as it is told and is sent again.
"""

from __future__ import annotations

import json
import time
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from ipaddress import ip_address
from typing import Any
from urllib.parse import urlsplit

import httpx

from service.refusals import Silence, Unreachable, Unusable, refusal

#: Statuses that mean "later"; the service says when in Retry-After.
LATER = frozenset({429, 503})
#: Longest one pause between two tries, and the pause when the service does not say, in seconds.
LONGEST_PAUSE, USUAL_PAUSE = 10.0, 1.0
#: Seconds without a byte after which a connection counts as dead; events send something every 15.
SILENCE_SECONDS = 60.0


class Transport:
    """Connections to one service.

    Parameters
    ----------
    url : str
        Address of the service.
    token : str or None
        Bearer token.
    patience : float
        Seconds for which a request is repeated while the service is full or away.

    Raises
    ------
    Unusable
        If the address is none.
    """

    def __init__(self, url: str, token: str | None, patience: float) -> None:
        parts = urlsplit(url)
        if parts.scheme not in {"http", "https"} or not parts.hostname:
            raise Unusable(f"{url!r} is no address of a service; say http://host:port")
        self.url = url.rstrip("/")
        self._patience = patience
        self._answered = False
        self._http = httpx.Client(
            base_url=self.url,
            headers={"Authorization": f"Bearer {token}"} if token else {},
            timeout=httpx.Timeout(SILENCE_SECONDS, connect=10.0),
            # A proxy meant for the world outside cannot reach this machine's own addresses.
            trust_env=not _is_here(parts.hostname),
        )

    def close(self) -> None:
        """Close the connections."""
        self._http.close()

    def answers(self, path: str) -> bool:
        """Whether a path is answered well; asks once and never fails."""
        try:
            return self._http.get(path, timeout=10.0).status_code == 200
        except httpx.HTTPError:
            return False

    def ask(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
        content: bytes | None = None,
    ) -> Any:
        """Send a request, again while the service is full or away, and read its JSON.

        Raises
        ------
        Refused
            For every status from 400 on.
        Unreachable
            If there is no answer, or none that can be read.
        """
        with self.stream(method, path, params=params, headers=headers, content=content) as response:
            try:
                return json.loads(response.read())
            except ValueError:
                raise Unreachable(f"{self.url} answers something that is not softmaps") from None

    @contextmanager
    def stream(
        self,
        method: str,
        path: str,
        *,
        params: Mapping[str, str] | None = None,
        headers: Mapping[str, str] | None = None,
        content: bytes | None = None,
        silence: float = SILENCE_SECONDS,
    ) -> Iterator[httpx.Response]:
        """Open a response whose body is still to be read; the same errors as `ask`.

        Raises
        ------
        Silence
            If nothing of the body comes for so many seconds.
        """
        deadline = time.monotonic() + self._patience
        timeout = httpx.Timeout(SILENCE_SECONDS, connect=10.0, read=silence)
        while True:
            request = self._http.build_request(
                method, path, params=params, headers=headers, content=content, timeout=timeout
            )
            try:
                response = self._http.send(request, stream=True)
            except httpx.TransportError as error:
                # A service that was there is being restarted; one that never answered is not there.
                hopeless = not self._answered or isinstance(error, httpx.ReadTimeout)
                if hopeless or time.monotonic() + USUAL_PAUSE > deadline:
                    raise Unreachable(f"no answer from {self.url}: {error}") from error
                time.sleep(USUAL_PAUSE)
                continue
            self._answered = True
            pause = _pause(response)
            if response.status_code in LATER and time.monotonic() + pause <= deadline:
                response.close()
                time.sleep(pause)
                continue
            break
        try:
            if response.status_code >= 400:
                response.read()
                raise refusal(response)
            yield response
        except httpx.ReadTimeout as error:
            raise Silence(f"{self.url} sent nothing more for {silence:g} s") from error
        except httpx.TransportError as error:
            raise Unreachable(f"the answer of {self.url} broke off: {error}") from error
        finally:
            response.close()


def _pause(response: httpx.Response) -> float:
    """Seconds that the service asks for, within reason."""
    said = response.headers.get("retry-after", "")
    return min(float(said), LONGEST_PAUSE) if said.isdecimal() else USUAL_PAUSE


def _is_here(host: str) -> bool:
    """Whether a host is this machine."""
    try:
        return ip_address(host).is_loopback
    except ValueError:
        return host == "localhost"
