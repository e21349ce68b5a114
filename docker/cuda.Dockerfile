# COW with PyTorch for NVIDIA GPUs: video models (`ati`, `wan-move`), and multimodal LLMs in the process, too.
#
#     docker build -f docker/cuda.Dockerfile -t cow:cuda .
#     docker run --rm -v cow-weights:/weights -v cow-cache:/cache cow:cuda models pull ati
#     docker run --rm --init --gpus all --stop-timeout 45 -p 127.0.0.1:8000:8000 -e COW_GENERATOR=ati \
#         -v cow-data:/data -v cow-weights:/weights -v cow-cache:/cache cow:cuda
#
# The machine needs NVIDIA's Container Toolkit and a driver for CUDA 13 (580 or newer); `docker run --rm --gpus all
# cow:cuda doctor` says what is missing. COW_PROFILE=exact, the default, and the profiles built on it compile parts of
# the model on the first clips: that takes the C++ compiler below and Python's headers, which the base image has.
#
# Without keys whoever reaches the port can use the server. Before it is published on more than 127.0.0.1:
#
#     docker run --rm cow:cuda keys new alice
#
# prints a key, and the COW_API_KEYS to give with `-e`. A folder in place of a volume must belong to 10001:10001.

# Not one of nvidia/cuda: PyTorch from PyPI brings CUDA's libraries, cuDNN and ptxas in the versions that it was built
# with, and the host brings the driver; a CUDA of the base would be a second one that nobody uses.
# An exact tag, to be raised on purpose. Whoever owns the registry can move a tag, and no digest: where that matters,
# look it up and build with --build-arg PYTHON_IMAGE=python:3.13.14-slim-trixie@sha256:...
ARG PYTHON_IMAGE=python:3.13.14-slim-trixie

FROM ${PYTHON_IMAGE} AS build
WORKDIR /src
COPY docker/locks/build.txt docker/locks/cuda.txt docker/locks/
# What is not in a lock, by version and SHA-256, is not installed (`make lock`). Wheels only: that takes no compiler, and
# runs no code of a package that is installed. pip stays out of the environment: an image that runs is not to be changed.
RUN python -m venv --without-pip /opt/cow
RUN --mount=type=cache,target=/root/.cache/pip \
    pip --python /opt/cow/bin/python install --only-binary :all: --require-hashes --requirement docker/locks/cuda.txt \
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
LABEL org.opencontainers.image.title="COW (CUDA)" \
      org.opencontainers.image.description="An inference service that lets a multimodal LLM look before it answers: one image and one what-if question in, imagined frames out." \
      org.opencontainers.image.version="${COW_VERSION}" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.base.name="docker.io/library/${PYTHON_IMAGE}"
# torch.compile and Triton call it while the server runs; it brings the C compiler and libc's headers along.
RUN apt-get update \
    && apt-get install --yes --no-install-recommends g++=4:14.2.0-1 \
    && rm -rf /var/lib/apt/lists/*
# A number that does not change from build to build: what lies in volumes belongs to it.
RUN groupadd --gid 10001 cow \
    && useradd --uid 10001 --gid cow --no-log-init --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin cow \
    && install --directory --owner=cow --group=cow /data /weights /cache
COPY --from=build /opt/cow /opt/cow
# What was compiled is loaded as a library: its folders must not lie on a tmpfs, which Docker mounts noexec.
ENV PATH=/opt/cow/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    COW_HOST=0.0.0.0 \
    COW_PORT=8000 \
    COW_DATA_DIR=/data \
    COW_MODELS_DIR=/weights \
    HF_HOME=/cache/huggingface \
    TORCHINDUCTOR_CACHE_DIR=/cache/inductor \
    TRITON_CACHE_DIR=/cache/triton
VOLUME ["/data", "/weights", "/cache"]
WORKDIR /data
USER 10001:10001
EXPOSE 8000
STOPSIGNAL SIGTERM
# Not by urllib: it would ask a proxy, where the environment names one. /livez needs no key.
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s --retries=3 \
    CMD ["python", "-c", "import http.client, os, sys; server = http.client.HTTPConnection('127.0.0.1', int(os.environ['COW_PORT']), timeout=4); server.request('GET', '/livez'); sys.exit(server.getresponse().status != 200)"]
ENTRYPOINT ["cow"]
CMD ["serve"]
