#!/bin/sh
# Makes gen/revisit/v1, the Go package of the API, with the generators of go.mod.
set -eu
mkdir -p gen
protoc -I ../../../proto \
  --plugin="$(go tool -n protoc-gen-go)" \
  --plugin="$(go tool -n protoc-gen-go-grpc)" \
  --go_out=gen --go_opt=paths=source_relative \
  --go-grpc_out=gen --go-grpc_opt=paths=source_relative \
  ../../../proto/revisit/v1/*.proto
