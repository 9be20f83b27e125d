# Runs the demo: docker build -t physhandi . && docker run --rm -p 127.0.0.1:8080:8080 physhandi
FROM python:3.11-slim-bookworm
RUN apt-get update \
 && apt-get install -y --no-install-recommends make libgl1 libegl1 libgomp1 \
 && rm -rf /var/lib/apt/lists/*
WORKDIR /opt/physhandi
COPY pyproject.toml constraints.txt Makefile README.md LICENSE ./
COPY app app
COPY physhandi physhandi
COPY web_assets web_assets
COPY sequences sequences
# The CPU build of torch keeps the image small; on a GPU host build with
# --build-arg TORCH=torch==2.13.0 --build-arg TORCH_INDEX= for the CUDA build.
ARG TORCH=torch==2.13.0
ARG TORCH_INDEX=
RUN python3 -m venv .venv \
 && .venv/bin/python -m pip install --no-cache-dir -c constraints.txt ${TORCH_INDEX:+--index-url "$TORCH_INDEX"} "$TORCH" \
 && .venv/bin/python -m pip install --no-cache-dir -c constraints.txt . \
 && .venv/bin/physhandi doctor
VOLUME /data
EXPOSE 8080
# The server listens on every interface of the container only; publish the port on loopback as above.
CMD [".venv/bin/physhandi", "serve", "--host", "0.0.0.0", "--port", "8080", "--data-dir", "/data", "--demo"]
