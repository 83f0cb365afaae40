# On CPUs:  docker build -t xplanes .
# On GPUs:  docker build -t xplanes:cuda --build-arg VARIANT=cuda .
# Use:      docker run --rm --read-only --tmpfs /tmp --volume "$PWD":/workspace xplanes train
# For GPUs, add --gpus all; where your user has another number than 1000, --user "$(id -u)".
FROM python:3.12-slim-bookworm

ARG VARIANT=cpu
ARG TORCH=2.13.0

ENV PIP_NO_CACHE_DIR=1 \
    PIP_DISABLE_PIP_VERSION_CHECK=1 \
    PYTHONDONTWRITEBYTECODE=1

SHELL ["/bin/bash", "-o", "pipefail", "-c"]

# PyPI has the builds for CUDA. Triton, which compiles the kernels, needs a C compiler; Debian keeps
# only the newest, so that a pinned version would soon be missing.
# hadolint ignore=DL3008
RUN case "$VARIANT" in \
    cpu) pip install "torch==$TORCH" --index-url https://download.pytorch.org/whl/cpu ;; \
    cuda) pip install "torch==$TORCH" \
        && apt-get update \
        && apt-get install -y --no-install-recommends gcc libc6-dev \
        && rm -rf /var/lib/apt/lists/* ;; \
    *) echo "VARIANT=$VARIANT: must be cpu or cuda" >&2; exit 1 ;; \
    esac

COPY . /tmp/xplanes
RUN pip install "/tmp/xplanes[export,video,viewer]" && rm -rf /tmp/xplanes

# All that is written, data/, outputs/ and caches, lies in the volume.
RUN useradd --uid 1000 --no-create-home xplanes && install -d -o xplanes /workspace
USER 1000
WORKDIR /workspace
VOLUME /workspace
ENV HOME=/tmp \
    USER=xplanes \
    HF_HOME=/workspace/.cache/huggingface \
    TRITON_CACHE_DIR=/workspace/.cache/triton \
    NUMBA_CACHE_DIR=/workspace/.cache/numba
ENTRYPOINT ["xplanes"]
CMD ["train"]
