"""Numbers for Prometheus, in its text format: what was asked of this process, what runs, what is stored."""

from __future__ import annotations

import threading
from bisect import bisect_left
from collections import Counter, defaultdict
from collections.abc import Mapping

#: Upper bounds of the histogram of seconds a request took.
BOUNDS = (0.005, 0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0)
#: What Prometheus wants to be told.
MEDIA_TYPE = "text/plain; version=0.0.4; charset=utf-8"


class RequestMetrics:
    """Counts requests by method, route and status, and their seconds by route."""

    def __init__(self) -> None:
        self._lock = threading.Lock()
        self._requests: Counter[tuple[str, str, int]] = Counter()
        self._buckets: dict[str, list[int]] = {}
        self._seconds: defaultdict[str, float] = defaultdict(float)

    def observe(self, method: str, route: str, status: int, seconds: float) -> None:
        """Count one request, by the template of its route (few values, whatever is asked for)."""
        with self._lock:
            self._requests[method, route, status] += 1
            buckets = self._buckets.setdefault(route, [0] * (len(BOUNDS) + 1))
            buckets[bisect_left(BOUNDS, seconds)] += 1
            self._seconds[route] += seconds

    def lines(self) -> list[str]:
        """Lines of the text format."""
        out = ["# TYPE softmaps_http_requests_total counter"]
        with self._lock:
            for (method, route, status), count in sorted(self._requests.items()):
                labels = f'method="{method}",route="{route}",status="{status}"'
                out.append(f"softmaps_http_requests_total{{{labels}}} {count}")
            name = "softmaps_http_request_seconds"
            out.append(f"# TYPE {name} histogram")
            for route, buckets in sorted(self._buckets.items()):
                total = 0
                for bound, count in zip((*map(str, BOUNDS), "+Inf"), buckets, strict=True):
                    total += count
                    out.append(f'{name}_bucket{{route="{route}",le="{bound}"}} {total}')
                out.append(f'{name}_sum{{route="{route}"}} {self._seconds[route]:.6f}')
                out.append(f'{name}_count{{route="{route}"}} {total}')
        return out


def gauges(numbers: Mapping[str, float | Mapping[str, float]]) -> list[str]:
    """Lines for numbers by name; a mapping of numbers is one gauge with a label for each."""
    out = []
    for name, value in numbers.items():
        out.append(f"# TYPE softmaps_{name} gauge")
        if isinstance(value, Mapping):
            out += [f'softmaps_{name}{{name="{label}"}} {number}' for label, number in sorted(value.items())]
        else:
            out.append(f"softmaps_{name} {value}")
    return out
