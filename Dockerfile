# One image for both parts: the service (`serve`, the default) and workers alone (`work`).
# tests/test_container.py lints this file and runs its steps without a container engine.
#
#   docker compose up --build          service and workers, see docker-compose.yml
#
# A tag may be moved to another image. To build on one that you have looked at, append the digest
# that `docker buildx imagetools inspect python:3.11-slim-bookworm` prints to both lines FROM, as
# @sha256:DIGEST (docs/deployment.md).
#   docker build -t sceneprint . && docker run -p 127.0.0.1:8008:8008 -v data:/data sceneprint
#
# Beyond its own machine the service asks for a key, and from within a container every caller is
# beyond it. The first key: docker compose exec service sceneprint keys --create NAME

FROM python:3.11-slim-bookworm AS build

# No cache: the layer would carry it. As an option here it holds for every step below.
ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PIP_ROOT_USER_ACTION=ignore

WORKDIR /src

# What changes seldom first, so that a change of code installs no dependency anew.
COPY requirements.lock ./

# Every file that is installed has a hash in the lock, or pip refuses it.
# The lock leaves open3d out: it takes 0.9 GB with its own dependencies, and needs libGL, libX11 and
# libusb. Only reconstructions and baselines load it (an import contract in pyproject.toml ensures
# that), and they say what to install.
# Without pip in the environment: the final stage installs nothing.
RUN python -m venv --without-pip /opt/sceneprint && \
    python -m pip --python /opt/sceneprint install --quiet --require-hashes --requirement requirements.lock

COPY pyproject.toml README.md LICENSE ./
COPY client client/
COPY migrations migrations/
COPY sceneprint sceneprint/
COPY service service/
COPY worker worker/

# --no-deps: our own requirement of open3d is left unmet on purpose. setuptools of the lock builds
# our wheels, so that none is fetched unchecked, and is not part of the image.
RUN python -m pip --python /opt/sceneprint wheel --quiet --no-deps --no-build-isolation --wheel-dir wheels ./client . && \
    python -m pip --python /opt/sceneprint install --quiet --no-deps wheels/*.whl && \
    python -m pip --python /opt/sceneprint uninstall --quiet --yes setuptools


FROM python:3.11-slim-bookworm

LABEL org.opencontainers.image.title="sceneprint" \
      org.opencontainers.image.description="Place recognition from pure geometry: service and workers" \
      org.opencontainers.image.version="1.0.0" \
      org.opencontainers.image.licenses="Apache-2.0"

# OMP, OPENBLAS: our kernels want one thread each (see Makefile).
# HOST: all addresses of the container; which of them the world reaches is published outside.
ENV PATH=/opt/sceneprint/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    OMP_NUM_THREADS=1 \
    OPENBLAS_NUM_THREADS=1 \
    NUMBA_CACHE_DIR=/var/cache/sceneprint/numba \
    SCENEPRINT_CACHE_DIR=/var/cache/sceneprint \
    SCENEPRINT_DATA_DIR=/data \
    SCENEPRINT_HOST=0.0.0.0 \
    SCENEPRINT_PORT=8008

# A fixed number, so that volumes keep their owner from image to image.
RUN groupadd --gid 10001 sceneprint && \
    useradd --uid 10001 --gid 10001 --no-create-home --home-dir /nonexistent --shell /usr/sbin/nologin sceneprint && \
    mkdir -p /data /var/cache/sceneprint && \
    chmod 0700 /data && \
    chown 10001:10001 /data /var/cache/sceneprint

COPY --from=build /opt/sceneprint /opt/sceneprint

USER 10001:10001

# Compile the kernels and build the pair tables now, as the user who runs them: numba uses a cache
# folder only where it may write, so one that root made would be passed over, and every process
# would compile for itself. The code is for every processor from x86-64-v3 on (2013 and later); on
# an older one the first use compiles once more, into the same folder.
RUN python -c "from sceneprint.cli.preparation import prepare_presets; \
    from sceneprint.settings import Settings; \
    prepare_presets(Settings(), clouds=True)"

VOLUME ["/data"]
EXPOSE 8008
STOPSIGNAL SIGTERM

# Of the service; docker-compose.yml has another for workers. It answers before kernels are loaded.
HEALTHCHECK --interval=15s --timeout=5s --start-period=120s --retries=3 \
    CMD ["python", "-c", "import http.client as h, os, ssl, sys; e = os.environ; a = ('127.0.0.1', int(e['SCENEPRINT_PORT'])); c = h.HTTPSConnection(*a, timeout=3, context=ssl._create_unverified_context()) if e.get('SCENEPRINT_TLS_CERT') else h.HTTPConnection(*a, timeout=3); c.request('GET', '/healthz'); sys.exit(c.getresponse().status != 200)"]

# The command, not `python -m service`: the same image makes keys and signs, and a
# container of its own is complete, as `serve` starts workers beside the service.
ENTRYPOINT ["sceneprint"]
CMD ["serve"]
