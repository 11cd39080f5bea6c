"""Tests of the rendered Helm chart against the schemas of Kubernetes and our code."""

import shutil
import subprocess
from pathlib import Path

import kubernetes_validate
import pytest
import yaml

from benchmarks.waiting import PATIENCE_S
from sceneprint.cli import COMMANDS
from sceneprint.settings import Settings
from service.metrics import METRICS

CHART = Path(__file__).resolve().parent.parent / "deploy" / "helm" / "sceneprint"
#: Version of Kubernetes whose schemas the rendered objects are held to.
KUBERNETES = "1.34"
#: Kinds that others define: their schemas are not among those of Kubernetes.
OF_OTHERS = {"ScaledObject", "TriggerAuthentication", "ServiceMonitor"}

REQUIRED = {
    # what has a colon is no password
    "database": {"url": "postgresql+psycopg://sceneprint@/x?host=a:5432&host=b:5432"},
    "blobs": {"url": "s3://bucket/fleet"},
    "secret": "sceneprint",
}
ALL = REQUIRED | {
    "serviceAccountName": "robots",
    "imagePullSecrets": [{"name": "registry"}],
    "image": {"digest": "sha256:" + "a" * 64},
    "env": {"AWS_REGION": "eu-central-1", "SCENEPRINT_UNDO_WINDOW_S": 60},
    "api": {"autoscaling": {"enabled": True}, "nodeSelector": {"disk": "ssd"}},
    "worker": {
        "autoscaling": {"enabled": True, "targetSeconds": 20},
        "tolerations": [{"key": "batch", "operator": "Exists"}],
    },
    "ingress": {
        "enabled": True,
        "host": "places.example",
        "tlsSecret": "tls",
        "className": "nginx",
    },
    "serviceMonitor": {"enabled": True},
    "dashboards": {"enabled": True},
}
SINGLE = {"single": {"enabled": True, "workers": 2, "dataSize": "9Gi", "storageClass": "local"}}


def run_helm(*arguments, values, folder):
    """Exit code, output and errors of Helm over the chart with these values."""
    helm = shutil.which("helm")
    if helm is None:
        pytest.skip("helm is not installed")
    path = folder / "values.yaml"
    path.write_text(yaml.safe_dump(values))
    command, *others = arguments
    done = subprocess.run(
        [helm, command, *others, str(CHART), "--values", str(path)],
        env={"HOME": str(folder), "PATH": ""}, capture_output=True, text=True, timeout=PATIENCE_S,
    )  # fmt: skip
    return done.returncode, done.stdout, done.stderr


def rendered(values, folder):
    """The objects of a release `fleet`, by kind and name."""
    returned, text, error = run_helm("template", "fleet", values=values, folder=folder)
    assert returned == 0, error
    objects = [resource for resource in yaml.safe_load_all(text) if resource is not None]
    by_name = {(resource["kind"], resource["metadata"]["name"]): resource for resource in objects}
    assert len(by_name) == len(objects)
    return by_name


def environment(container):
    return {variable["name"]: variable["value"] for variable in container["env"]}


@pytest.mark.parametrize("values", [REQUIRED, ALL, SINGLE], ids=["required", "all", "single"])
def test_helm_and_kubernetes_accept_it(values, tmp_path):
    returned, text, error = run_helm("lint", "--strict", values=values, folder=tmp_path)
    assert (returned, "0 chart(s) failed" in text) == (0, True), text + error
    objects = rendered(values, tmp_path)
    kinds = {kind for kind, _ in objects}
    basic = {"Deployment", "Service", "PodDisruptionBudget", "NetworkPolicy", "Job"}
    more = {"HorizontalPodAutoscaler", "Ingress", "ConfigMap"} | OF_OTHERS
    if values is SINGLE:
        assert kinds == basic - {"Job"} | {"PersistentVolumeClaim"}
    else:
        assert kinds == (basic | more if values is ALL else basic)
    for (kind, _), resource in objects.items():
        if kind not in OF_OTHERS:
            kubernetes_validate.validate(resource, KUBERNETES, strict=True)


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"secret": ""}, "/secret"),
        ({"database": {"url": "mysql://db/x"}}, "database.url must be postgresql+psycopg://"),
        ({"blobs": {"url": "/mnt/blobs"}}, "/blobs/url"),
        ({"ingress": {"enabled": True}}, "set ingress.host"),
    ],
)
def test_values_that_cannot_work_are_refused(change, message, tmp_path):
    returned, _, error = run_helm("template", "fleet", values=REQUIRED | change, folder=tmp_path)
    assert returned != 0
    assert message in error


@pytest.mark.parametrize(
    "url",
    [
        "postgresql://sceneprint:hush@db/x",
        "postgresql+psycopg://sceneprint:hu/sh@db:5432/x",
        "postgres://:hush@/x?host=a:5432&host=b:5432",
        "postgresql://sceneprint@db/x?sslmode=require&password=hush",
    ],
)
def test_a_password_in_a_url_is_refused_and_not_repeated(url, tmp_path):
    values = REQUIRED | {"database": REQUIRED["database"] | {"url": url}}
    returned, said, error = run_helm("template", "fleet", values=values, folder=tmp_path)
    assert (returned, said) == (1, "")
    reason = "database.url must not contain a password: put PGPASSWORD into the secret"
    assert reason in error
    assert "sh@" not in error
    assert "hush" not in error


def test_pods_run_our_commands_with_our_settings(tmp_path):
    settable = {f"SCENEPRINT_{name.upper()}" for name in Settings.model_fields} | {"AWS_REGION"}
    objects = rendered(ALL, tmp_path)
    parts = {
        "serve": objects["Deployment", "fleet-api"],
        "work": objects["Deployment", "fleet-worker"],
        "migrate": objects["Job", "fleet-migration"],
    }
    for command, part in parts.items():
        pod = part["spec"]["template"]["spec"]
        (container,) = pod["containers"]
        assert container["args"] == [command]
        assert command in COMMANDS
        variables = environment(container)
        assert variables.keys() - settable == set()
        own = {
            k.removeprefix("SCENEPRINT_").lower(): v for k, v in variables.items() if k[:3] == "SCE"
        }
        settings = Settings(**own)  # texts, as in the environment
        assert settings.database == REQUIRED["database"]["url"]
        assert container["image"] == f"sceneprint@sha256:{'a' * 64}"
        assert container["envFrom"] == [{"secretRef": {"name": "sceneprint"}}]
        assert pod["securityContext"]["runAsUser"] == 10001  # that of the Dockerfile
        assert container["securityContext"]["readOnlyRootFilesystem"] is True
        mounts = {mount["mountPath"] for mount in container["volumeMounts"]}
        assert mounts == {"/data", "/var/cache/sceneprint", "/tmp"}
    assert environment(parts["serve"]["spec"]["template"]["spec"]["containers"][0]).items() >= {
        ("SCENEPRINT_WORKERS", "0"), ("SCENEPRINT_UNDO_WINDOW_S", "60"),
    }  # fmt: skip


def test_the_schema_is_migrated_before_pods_are_replaced(tmp_path):
    objects = rendered(REQUIRED, tmp_path)
    annotations = objects["Job", "fleet-migration"]["metadata"]["annotations"]
    assert annotations["helm.sh/hook"] == "pre-install,pre-upgrade"
    without = rendered(REQUIRED | {"migration": {"enabled": False}}, tmp_path)
    assert ("Job", "fleet-migration") not in without


def test_workers_are_added_by_a_metric_of_the_service(tmp_path):
    (trigger,) = rendered(ALL, tmp_path)["ScaledObject", "fleet-worker"]["spec"]["triggers"]
    assert trigger["metadata"]["valueLocation"].removeprefix("sceneprint_") in METRICS
    assert trigger["metadata"]["targetValue"] == "20"


def test_the_volume_of_a_single_pod_outlives_its_release(tmp_path):
    objects = rendered(SINGLE, tmp_path)
    claim = objects["PersistentVolumeClaim", "fleet-data"]
    assert claim["metadata"]["annotations"] == {"helm.sh/resource-policy": "keep"}
    (pod,) = (resource["spec"] for (kind, _), resource in objects.items() if kind == "Deployment")
    assert (pod["replicas"], pod["strategy"]) == (1, {"type": "Recreate"})
    data = {"name": "data", "persistentVolumeClaim": {"claimName": "fleet-data"}}
    assert data in pod["template"]["spec"]["volumes"]
