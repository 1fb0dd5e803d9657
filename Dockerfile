# ct2lut in a container: built in one stage, run in another without compilers, pip or root. docs/container.md says how.
#
#   docker build -t ct2lut .
#   docker run --rm --read-only --tmpfs /tmp --network none --cap-drop ALL --security-opt no-new-privileges \
#     --user "$(id -u):$(id -g)" -v "$PWD/cases:/cases:ro" -v "$PWD/results:/results" \
#     ct2lut run P001 --cases /cases --results /results

# Name and digest of a Debian 12: BASE=debian:bookworm-slim@sha256:... is the same base on every machine.
ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
# Python packages are pinned by hash; Debian's are those of the day, with their security updates, and stand in the SBOM.
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv ca-certificates \
    && apt-get clean && rm -rf /var/lib/apt/lists/*
WORKDIR /src
RUN python3 -m venv /opt/ct2lut
COPY requirements.lock ./
RUN /opt/ct2lut/bin/pip install --no-cache-dir --require-hashes --requirement requirements.lock
# The engine of cohorts stands apart: it wants older packages than a run does. Not needed: tests, a solver of plans
COPY requirements-cohort.lock ./
RUN python3 -m venv /opt/ct2lut-cohort \
    && /opt/ct2lut-cohort/bin/pip install --no-cache-dir --require-hashes --requirement requirements-cohort.lock \
    && /opt/ct2lut-cohort/bin/pip uninstall --yes setuptools pip \
    && rm -r /opt/ct2lut-cohort/lib/python3.*/site-packages/pandas/tests \
       /opt/ct2lut-cohort/lib/python3.*/site-packages/pulp/solverdir/cbc
COPY pyproject.toml README.md LICENSE ./
COPY pipeline pipeline
RUN /opt/ct2lut/bin/pip install --no-cache-dir --no-deps --no-build-isolation . \
    && /opt/ct2lut/bin/pip uninstall --yes cython setuptools wheel pip \
    && NUMBA_CPU_NAME=generic /opt/ct2lut/bin/ct2lut compile

FROM ${BASE}
# EGL with the software renderer: pictures without a display or a graphics card; Pango and a font: report.pdf
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 libegl1 libgl1-mesa-dri \
       libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0 fonts-dejavu-core \
    && apt-get clean && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/ct2lut-cohort /opt/ct2lut-cohort
COPY --from=build /opt/ct2lut /opt/ct2lut
COPY tools/inventory.py /opt/ct2lut/share/inventory.py
RUN /opt/ct2lut/bin/python /opt/ct2lut/share/inventory.py /opt/ct2lut/share /opt/ct2lut-cohort/lib/python3.*/site-packages
# Works for any user ID, without a home and on a read-only root: what libraries cache goes to /tmp
ENV PATH=/opt/ct2lut/bin:$PATH \
    PYTHONSAFEPATH=1 \
    PYTHONDONTWRITEBYTECODE=1 \
    NUMBA_CPU_NAME=generic \
    NUMBA_CACHE_LOCATOR_CLASSES=pipeline.adapters.kernel_cache.ShippedKernels,InTreeCacheLocator,UserWideCacheLocator \
    VTK_DEFAULT_OPENGL_WINDOW=vtkEGLRenderWindow \
    HOME=/tmp \
    MPLCONFIGDIR=/tmp/matplotlib \
    XDG_CACHE_HOME=/tmp/cache
ARG BASE
ARG REVISION=unknown
LABEL org.opencontainers.image.title="ct2lut" \
      org.opencontainers.image.description="From a CT of a joint and its segmentation to the look-up table that animates it" \
      org.opencontainers.image.version="0.1.0" \
      org.opencontainers.image.revision="${REVISION}" \
      org.opencontainers.image.licenses="Apache-2.0" \
      org.opencontainers.image.base.name="${BASE}"
USER 65532:65532
WORKDIR /data
# Says that the program starts; `ct2lut doctor --results FOLDER` looks at the rest, by hand or in a service
HEALTHCHECK --interval=5m --timeout=1m CMD ["ct2lut", "--version"]
ENTRYPOINT ["ct2lut"]
CMD ["--help"]
