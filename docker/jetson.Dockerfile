# One robot's agent on a Jetson with JetPack 7 or later (Ubuntu 24.04, Python 3.12, CUDA 13), with MASt3R on its GPU
# (docker/README.md). Build it on the Jetson, from the repository's root:
#     docker build --file docker/jetson.Dockerfile --tag flocc-jetson:0.1.0 .
#
# torch is the vendor's, from the base image; pip must not replace it. JetPack 6 has Python 3.10: see docker/README.md.

ARG BASE=nvcr.io/nvidia/pytorch:25.08-py3
FROM ${BASE}
SHELL ["/bin/bash", "-o", "pipefail", "-c"]
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY protocol protocol
COPY agent agent
COPY launch launch
RUN python3 -m venv --system-site-packages /opt/flocc \
    && python3 -m pip list --format=freeze | grep -E "^(torch|triton)" > vendor.txt \
    && grep -v -E "^(torch|triton|nvidia|numpy|scipy|setuptools)" constraints.txt > pinned.txt \
    && /opt/flocc/bin/pip install --no-cache-dir --disable-pip-version-check -c pinned.txt ".[ros2,secure,mast3r]" \
    && /opt/flocc/bin/python -m pip list --format=freeze | grep -E "^(torch|triton)" | diff - vendor.txt
RUN groupadd --gid 10001 flocc \
    && useradd --uid 10001 --gid flocc --groups video --create-home --shell /usr/sbin/nologin flocc \
    && install -d -o flocc -g flocc /data /recordings /etc/flocc
ENV PATH=/opt/flocc/bin:$PATH PYTHONUNBUFFERED=1 OMP_NUM_THREADS=2
USER 10001:10001
WORKDIR /data
VOLUME ["/data"]

# An agent with `folder` below /data writes an event at least once a second.
HEALTHCHECK --interval=30s --timeout=5s --start-period=120s --retries=3 \
    CMD ["sh", "-c", "find /data -name events.jsonl -mmin -1 | grep -q ."]
ENTRYPOINT ["flocc"]
CMD ["agent", "--config", "/etc/flocc/agent.toml"]
