#!/usr/bin/env bash
# What a popgen container does, by its first word:
#   head [OPTION...]       the head of a Ray cluster; options are those of `ray start`
#   worker [OPTION...]     a node that joins the cluster at RAY_HEAD (HOST:PORT)
#   run [KEY=VALUE...]     generate a population: as a job of the cluster at RAY_API_SERVER_ADDRESS (with
#                          cluster=POPGEN_CLUSTER, nodes without it), or on its own
#   mlflow [OPTION...]     a tracking server that keeps everything in MLFLOW_DATA
#   health ROLE            exit code 0 if this container's head, worker or mlflow answers
# and any other command of popgen (evaluate, show, runs, bench, --help).
#
# A cluster has a token of its own, in RAY_AUTH_TOKEN or in the file RAY_AUTH_TOKEN_PATH; without one nothing starts.
set -euo pipefail

fail() {
    echo "popgen: error: $*" >&2
    exit 2
}

need_token() {
    local make="make one with: openssl rand -hex 32"
    export RAY_AUTH_MODE=token
    if [[ -n "${RAY_AUTH_TOKEN:-}" ]]; then
        ((${#RAY_AUTH_TOKEN} >= 32)) || fail "RAY_AUTH_TOKEN: is shorter than 32 characters; $make"
    elif [[ -n "${RAY_AUTH_TOKEN_PATH:-}" ]]; then
        [[ -s "$RAY_AUTH_TOKEN_PATH" ]] || fail "RAY_AUTH_TOKEN_PATH: $RAY_AUTH_TOKEN_PATH is empty or not there; $make"
    else
        fail "RAY_AUTH_TOKEN: is not set; $make"
    fi
}

answers() { # URL
    python -c 'import sys, urllib.request; urllib.request.urlopen(sys.argv[1], timeout=8).close()' "$1" 2>/dev/null
}

health() {
    case "${1:-}" in
        head) answers "http://127.0.0.1:$dashboard/api/gcs_healthz" ;;
        worker) answers "http://127.0.0.1:$agent/api/local_raylet_healthz" ;;
        mlflow) answers "http://127.0.0.1:$mlflow/health" ;;
        *) fail "health: unknown role '${1:-}'; choose head, worker or mlflow" ;;
    esac
}

port="${RAY_PORT:-6379}" dashboard="${DASHBOARD_PORT:-8265}" agent="${AGENT_PORT:-52365}" mlflow="${MLFLOW_PORT:-5000}"
node=(--block --disable-usage-stats --dashboard-agent-listen-port="$agent")
export RAY_USAGE_STATS_ENABLED=0
role="${1:---help}"
shift || true
case "$role" in
    head)
        need_token
        # The dashboard, which takes the jobs too, stays on the loopback unless asked otherwise.
        exec ray start --head --port="$port" --include-dashboard=true --dashboard-port="$dashboard" \
            --dashboard-host="${DASHBOARD_HOST:-127.0.0.1}" "${node[@]}" "$@"
        ;;
    worker)
        need_token
        [[ "${RAY_HEAD:-}" =~ ^[^:]+:[0-9]+$ ]] || fail "RAY_HEAD: must be HOST:PORT of the head, got '${RAY_HEAD:-}'"
        exec ray start --address="$RAY_HEAD" "${node[@]}" "$@"
        ;;
    run)
        [[ -n "${RAY_API_SERVER_ADDRESS:-}" ]] || exec popgen run "$@"
        need_token
        exec ray job submit -- popgen run cluster="${POPGEN_CLUSTER:-nodes}" "$@"
        ;;
    mlflow)
        data="${MLFLOW_DATA:-$HOME/mlflow}"
        mkdir -p "$data/artifacts"
        exec mlflow server --host "${MLFLOW_HOST:-0.0.0.0}" --port "$mlflow" --workers "${MLFLOW_WORKERS:-2}" \
            --backend-store-uri "sqlite:///$data/mlflow.db" --artifacts-destination "$data/artifacts" "$@"
        ;;
    health) health "$@" ;;
    *) exec popgen "$role" "$@" ;;
esac
