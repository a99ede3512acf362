#!/bin/sh
# Asks a daemon for what its own OpenAPI document allows and forbids, by schemathesis (`pip install schemathesis`).
#
#     tests/bench/schemathesis.sh PROGRAM SESSION [FURTHER ARGUMENTS OF `st run`...]
#
# PROGRAM replays SESSION over and over, with a scan that has ended and one that goes on, and must not answer with 5xx, nor otherwise
# than its document says. The two streams are left out: they have no end; and no more is asked than commands are taken. The exit code is schemathesis'; 1 if the daemon is gone.
set -eu
program=$1 session=$2
shift 2
port=${PORT:-8096}
base=http://127.0.0.1:$port
scratch=$(mktemp -d)
"$program" run --replay "$session" --repeat --listen "127.0.0.1:$port" --data "$scratch/data" >"$scratch/log" 2>&1 &
daemon=$!
trap 'kill $daemon 2>/dev/null || :; wait $daemon || :; rm -rf "$scratch"' EXIT
until curl --silent --fail "$base/healthz" >"$scratch/health"; do
    kill -0 $daemon
    sleep 0.2
done

post() { curl --silent --fail --request POST "$base/api/v1/$1" --output "$scratch/answer"; }
post scan
sleep 5
post scan/finish
until curl --silent "$base/api/v1/status" | grep --quiet '"state":"idle"'; do
    sleep 1
done
post scan

code=0
st run "$base/api/v1/openapi.json" --exclude-path /api/v1/events --exclude-path /api/v1/ws --rate-limit 8/s --seed 1 "$@" || code=$?
kill -0 $daemon || { tail "$scratch/log"; exit 1; }
exit $code
