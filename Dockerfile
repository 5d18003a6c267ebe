# teatbench with its emulated instruments, for CI: docker build -t teatbench .
FROM debian:bookworm-slim

RUN apt-get update \
 && apt-get install -y --no-install-recommends python3 python3-venv git ca-certificates \
 && rm -rf /var/lib/apt/lists/*

COPY . /src
RUN python3 -m venv /opt/teatbench \
 && /opt/teatbench/bin/pip install --no-cache-dir --require-hashes -r /src/locks/run.txt \
 && /opt/teatbench/bin/pip install --no-cache-dir --no-deps --no-build-isolation /src \
 && rm -rf /src
ENV PATH=/opt/teatbench/bin:$PATH

# no root: jobs write in their own folder
RUN useradd --create-home bench
USER bench
WORKDIR /home/bench
CMD ["teatbench", "--help"]
