# just TASK; each line is a command that also works alone

install:
    bash install.sh

test *ARGS:
    .venv/bin/python -m pytest {{ARGS}}

check:
    .venv/bin/ruff check . && .venv/bin/ruff format --check . && .venv/bin/mypy && .venv/bin/lint-imports

serve:
    .venv/bin/straightpcf serve

quality *ARGS:
    .venv/bin/python -m benchmarks.quality --split punet {{ARGS}}

# the gRPC stubs, which are committed
proto:
    .venv/bin/python -m grpc_tools.protoc -I src --python_out=src --pyi_out=src --grpc_python_out=src \
        straightpcf/points/wire/straightpcf.proto
