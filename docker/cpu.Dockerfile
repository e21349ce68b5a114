# COW on any machine: the default backends, and multimodal LLMs that are served elsewhere.
#
#     docker build -f docker/cpu.Dockerfile -t cow:cpu .
#     docker run --rm --init --stop-timeout 45 -p 127.0.0.1:8000:8000 -v cow-data:/data cow:cpu
#
# Without keys whoever reaches the port can use the server. Before it is published on more than 127.0.0.1:
#
#     docker run --rm cow:cpu keys new alice
#
# prints a key, and the COW_API_KEYS to give with `-e`. A folder in place of the volume must belong to 10001:10001.

# An exact tag, to be raised on purpose. Whoever owns the registry can move a tag, and no digest: where that matters,
# look it up and build with --build-arg PYTHON_IMAGE=python:3.13.14-slim-trixie@sha256:...
ARG PYTHON_IMAGE=python:3.13.14-slim-trixie

FROM ${PYTHON_IMAGE} AS build
WORKDIR /src
COPY docker/locks/build.txt docker/locks/cpu.txt docker/locks/
# What is not in a lock, by version and SHA-256, is not installed (`make lock`). Wheels only: that takes no compiler, and
# runs no code of a package that is installed. pip stays out of the environment: an image that runs is not to be changed.
RUN python -m venv --without-pip /opt/cow
RUN --mount=type=cache,target=/root/.cache/pip \
    pip --python /opt/cow/bin/python install --only-binary :all: --require-hashes --requirement docker/locks/cpu.txt \
    && pip install --only-binary :all: --require-hashes --requirement docker/locks/build.txt
COPY pyproject.toml hatch_build.py README.md LICENSE ./
COPY models models
COPY prompts prompts
COPY examples/ball-and-mug/image.jpg examples/ball-and-mug/film.mp4 examples/ball-and-mug/
COPY examples/falling-ball/image.jpg examples/falling-ball/film.mp4 examples/falling-ball/
COPY examples/bottle-passes-cylinder/image.jpg examples/bottle-passes-cylinder/film.mp4 examples/bottle-passes-cylinder/
COPY examples/thrown-ball/image.jpg examples/thrown-ball/film.mp4 examples/thrown-ball/
COPY cow_service cow_service
RUN pip wheel --no-cache-dir --no-deps --no-build-isolation --wheel-dir /wheels /src \
    && pip --python /opt/cow/bin/python install --no-cache-dir --no-deps --no-index /wheels/*.whl

FROM ${PYTHON_IMAGE}
ARG PYTHON_IMAGE
ARG COW_VERSION=0.2.0
LABEL org.opencontainers.image.title="COW" \
      org.opencontainers.image.description="An inference service that lets a multimodal LLM look before it answers: one image and one what-if question in, imagined frames out." \
      org.opencontainers.image.version="${COW_VERSION}" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.base.name="docker.io/library/${PYTHON_IMAGE}"
# A number that does not change from build to build: what lies in volumes belongs to it.
RUN groupadd --gid 10001 cow \
    && useradd --uid 10001 --gid cow --no-log-init --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin cow \
    && install --directory --owner=cow --group=cow /data
COPY --from=build /opt/cow /opt/cow
ENV PATH=/opt/cow/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    COW_HOST=0.0.0.0 \
    COW_PORT=8000 \
    COW_DATA_DIR=/data
VOLUME ["/data"]
WORKDIR /data
USER 10001:10001
EXPOSE 8000
STOPSIGNAL SIGTERM
# Not by urllib: it would ask a proxy, where the environment names one. /livez needs no key.
HEALTHCHECK --interval=30s --timeout=5s --start-period=30s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; server = http.client.HTTPConnection('127.0.0.1', int(os.environ['COW_PORT']), timeout=4); server.request('GET', '/livez'); sys.exit(server.getresponse().status != 200)"]
ENTRYPOINT ["cow"]
CMD ["serve"]
