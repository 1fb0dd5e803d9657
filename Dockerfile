# ct2lut in a container: built in one stage, run in another without compilers, pip or root.
#
#   docker build -t ct2lut .
#   docker run --rm --read-only --tmpfs /tmp --network none --cap-drop ALL --security-opt no-new-privileges \
#     --user "$(id -u):$(id -g)" -v "$PWD/cases:/cases:ro" -v "$PWD/results:/results" \
#     ct2lut run P001 --cases /cases --results /results
ARG BASE=debian:bookworm-slim

FROM ${BASE} AS build
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 python3-venv ca-certificates \
    && rm -rf /var/lib/apt/lists/*
WORKDIR /src
RUN python3 -m venv /opt/ct2lut
COPY requirements.lock ./
RUN /opt/ct2lut/bin/pip install --no-cache-dir --require-hashes --requirement requirements.lock
COPY pyproject.toml README.md LICENSE ./
COPY pipeline pipeline
RUN /opt/ct2lut/bin/pip install --no-cache-dir --no-deps --no-build-isolation . \
    && /opt/ct2lut/bin/pip uninstall --yes cython setuptools wheel pip \
    && NUMBA_CPU_NAME=generic /opt/ct2lut/bin/ct2lut compile

FROM ${BASE}
# EGL with the software renderer: pictures without a display or a graphics card; Pango and a font: report.pdf
RUN apt-get update \
    && apt-get install -y --no-install-recommends python3 libegl1 libgl1-mesa-dri \
       libpango-1.0-0 libpangoft2-1.0-0 libharfbuzz-subset0 fonts-dejavu-core \
    && rm -rf /var/lib/apt/lists/*
COPY --from=build /opt/ct2lut /opt/ct2lut
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
USER 65532:65532
WORKDIR /data
ENTRYPOINT ["ct2lut"]
CMD ["--help"]
