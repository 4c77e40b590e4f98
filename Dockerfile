# docker build -t straightpcf .                                   CPU
# docker build -t straightpcf --build-arg TORCH=cuda .            CUDA (run with --gpus all)
ARG PYTHON=3.11

FROM python:${PYTHON}-slim AS build
ARG TORCH=cpu
# hadolint ignore=DL3008
RUN apt-get update \
    && apt-get install -y --no-install-recommends g++ \
    && rm -rf /var/lib/apt/lists/*
# The public index serves CUDA builds of torch, PyTorch's own the CPU build.
RUN case "$TORCH" in cpu|cuda) ;; *) echo "TORCH is $TORCH; it must be cpu or cuda" >&2; exit 1 ;; esac \
    && python -m venv /venv \
    && if [ "$TORCH" = cpu ]; then \
        /venv/bin/pip install --no-cache-dir "torch>=2.6,<3" --index-url https://download.pytorch.org/whl/cpu; \
    fi
WORKDIR /source
COPY pyproject.toml README.md ./
COPY src src
COPY points points
COPY model model
COPY service service
COPY clients clients
# The image does not know its processor: carry the kernels for each instruction set.
RUN /venv/bin/pip install --no-cache-dir ".[service,grpc,las]" \
    && /venv/bin/python -c "from pathlib import Path; from straightpcf.model.kernels import cpu; cpu.build_all(Path(cpu.__file__).with_name('lib'))"

FROM python:${PYTHON}-slim
ARG TORCH=cpu
# Triton compiles a launcher for each of its kernels where they run.
# hadolint ignore=DL3008
RUN if [ "$TORCH" != cpu ]; then \
        apt-get update \
        && apt-get install -y --no-install-recommends gcc libc6-dev \
        && rm -rf /var/lib/apt/lists/*; \
    fi
LABEL org.opencontainers.image.title="straightpcf" \
      org.opencontainers.image.description="Point-cloud denoising as a service" \
      org.opencontainers.image.licenses="MIT"
# Group 0 may write /data, too: OpenShift gives a container a user of its own, in that group.
RUN useradd --create-home --uid 10001 straightpcf \
    && install -d -o straightpcf -g 0 -m 0770 /data
COPY --from=build /venv /venv
USER 10001
ENV PATH=/venv/bin:$PATH \
    PYTHONUNBUFFERED=1 \
    STRAIGHTPCF_DATA_DIR=/data \
    TRITON_CACHE_DIR=/data/.triton \
    STRAIGHTPCF_GRPC_PORT=50051
VOLUME /data
EXPOSE 8000 50051
# Not by urllib, which would ask the proxy that Docker may put into the environment.
HEALTHCHECK --interval=10s --timeout=3s --start-period=60s \
    CMD ["python", "-c", "from http.client import *; c = HTTPConnection('127.0.0.1', 8000, timeout=2); c.request('GET', '/readyz'); exit(c.getresponse().status != 200)"]
ENTRYPOINT ["straightpcf"]
CMD ["serve", "--host", "0.0.0.0", "--port", "8000"]
