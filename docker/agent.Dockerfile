# One robot's agent, without a GPU: x86-64 and arm64 (docker/README.md). Build it from the repository's root:
#     docker buildx build --platform linux/amd64,linux/arm64 --file docker/agent.Dockerfile --tag flocc-agent:0.1.0 .

FROM python:3.12-slim-bookworm AS build
WORKDIR /src
COPY pyproject.toml constraints.txt README.md LICENSE ./
COPY protocol protocol
COPY agent agent
COPY launch launch
RUN python -m venv /opt/flocc \
    && /opt/flocc/bin/pip install --no-cache-dir --disable-pip-version-check -c constraints.txt ".[ros2,secure]"

FROM python:3.12-slim-bookworm
RUN groupadd --gid 10001 flocc \
    && useradd --uid 10001 --gid flocc --create-home --shell /usr/sbin/nologin flocc \
    && install -d -o flocc -g flocc /data /recordings /etc/flocc
COPY --from=build /opt/flocc /opt/flocc
ENV PATH=/opt/flocc/bin:$PATH PYTHONUNBUFFERED=1 OMP_NUM_THREADS=1
USER 10001:10001
WORKDIR /data
VOLUME ["/data"]

# An agent with `folder` below /data writes an event at least once a second.
HEALTHCHECK --interval=30s --timeout=5s --start-period=30s --retries=3 \
    CMD ["sh", "-c", "find /data -name events.jsonl -mmin -1 | grep -q ."]
ENTRYPOINT ["flocc"]
CMD ["agent", "--config", "/etc/flocc/agent.toml"]
