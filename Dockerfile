# PhysHanDI's server. A GPU needs the NVIDIA container toolkit and nothing else here: torch and Warp
# bring their own CUDA libraries. Without one, --build-arg TORCH_INDEX=https://download.pytorch.org/whl/cpu
# makes the image 3 GB smaller. How to run it: docs/operations.md.
FROM debian:bookworm-slim

RUN apt-get update \
    && DEBIAN_FRONTEND=noninteractive apt-get install -y --no-install-recommends ca-certificates python3 python3-venv tini \
    && rm -rf /var/lib/apt/lists/*

# Fits, scenes and what is uploaded must not run as root.
RUN useradd --uid 1000 --create-home physhandi \
    && install -d -o physhandi -g physhandi /data

ARG TORCH_INDEX=
COPY constraints.txt /opt/physhandi/
RUN python3 -m venv /opt/venv \
    && /opt/venv/bin/pip install --no-cache-dir --upgrade pip \
    && torch="$(grep '^torch==' /opt/physhandi/constraints.txt)" \
    && /opt/venv/bin/pip install --no-cache-dir ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$torch"

COPY pyproject.toml README.md LICENSE /opt/physhandi/
COPY physhandi /opt/physhandi/physhandi
COPY app /opt/physhandi/app
COPY web_assets /opt/physhandi/web_assets
COPY sequences /opt/physhandi/sequences
RUN /opt/venv/bin/pip install --no-cache-dir -c /opt/physhandi/constraints.txt -e "/opt/physhandi[capture,usd]" \
    && /opt/venv/bin/physhandi --help > /dev/null

ENV PATH=/opt/venv/bin:/usr/local/bin:/usr/bin:/bin
ENV PYTHONUNBUFFERED=1
ENV PHYSHANDI_HOST=0.0.0.0
ENV PHYSHANDI_DATA_DIR=/data
# What Warp compiles is kept with the data: the next container does not compile it again.
ENV WARP_CACHE_PATH=/data/cache/kernels
USER physhandi
WORKDIR /data
VOLUME /data
EXPOSE 8080
HEALTHCHECK --interval=30s --timeout=5s --start-period=60s CMD python -c "import urllib.request; urllib.request.urlopen('http://127.0.0.1:8080/healthz', timeout=4)"
# Processes of fits whose supervisor was killed are adopted and reaped.
ENTRYPOINT ["tini", "--", "physhandi"]
CMD ["serve"]
