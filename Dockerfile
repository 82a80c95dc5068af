# Operator and worker in one file, an image for each: docker build --target operator (or worker) .
# Of many platforms: docker buildx build --platform linux/amd64,linux/arm64 ...
FROM rust:1.95-slim-trixie AS build
RUN apt-get update && apt-get install -y --no-install-recommends build-essential cmake perl && rm -rf /var/lib/apt/lists/*
WORKDIR /src
COPY . .
RUN cargo build --release --locked -p rayherd-operator -p rayherd-worker \
    && mkdir /out && cp target/release/rayherd-operator target/release/rayherd-worker /out/

# libc and certificates; runs as nobody in particular (65532), with a read-only root
FROM debian:trixie-slim AS base
RUN apt-get update && apt-get install -y --no-install-recommends ca-certificates && rm -rf /var/lib/apt/lists/*
USER 65532:65532

FROM base AS operator
COPY --from=build /out/rayherd-operator /rayherd-operator
ENTRYPOINT ["/rayherd-operator"]

FROM base AS worker
COPY --from=build /out/rayherd-worker /rayherd-worker
ENTRYPOINT ["/rayherd-worker"]
