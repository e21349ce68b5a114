"""Files for Kubernetes, Prometheus and Grafana, held against schemas, settings and a real server's metrics."""

from __future__ import annotations

import json
import re
from typing import Any

import httpx
import kubernetes_validate
import pytest
import yaml
from conftest import ROOT
from containers import IMAGES, check_cow, check_settings, longest_stop, pairs, texts

KUBERNETES = ROOT / "docker" / "kubernetes"
OLDEST_KUBERNETES = "1.30"  # that the files are for
ALERTS = yaml.safe_load((ROOT / "docker" / "prometheus" / "alerts.yaml").read_text())
RULES: list[dict[str, Any]] = [rule for group in ALERTS["groups"] for rule in group["rules"]]
DASHBOARD = json.loads((ROOT / "docker" / "grafana" / "cow.json").read_text())
OF_PROMETHEUS = {"up"}  # that it makes itself
RUNBOOK = (ROOT / "docs" / "runbook.md").read_text()


def resources() -> list[dict[str, Any]]:
    listed = yaml.safe_load((KUBERNETES / "kustomization.yaml").read_text())["resources"]
    assert set(listed) == {path.name for path in KUBERNETES.glob("*.yaml")} - {"kustomization.yaml"}
    return [one for name in listed for one in yaml.safe_load_all((KUBERNETES / name).read_text())]


RESOURCES = resources()
BUILT_IN = [one for one in RESOURCES if not one["apiVersion"].startswith("ray.io/")]
DEPLOYMENTS = {one["metadata"]["name"]: one for one in RESOURCES if one["kind"] == "Deployment"}


def of_kind(kind: str) -> list[dict[str, Any]]:
    return [one for one in RESOURCES if one["kind"] == kind]


def container_of(workload: dict[str, Any]) -> dict[str, Any]:
    (container,) = workload["spec"]["template"]["spec"]["containers"]
    return container


@pytest.mark.parametrize("resource", BUILT_IN, ids=lambda one: f"{one['kind']}-{one['metadata']['name']}")
def test_resources_are_those_of_kubernetes(resource: dict[str, Any]) -> None:
    for version in (OLDEST_KUBERNETES, kubernetes_validate.latest_version()):
        kubernetes_validate.validate(resource, version, strict=True)


@pytest.mark.parametrize("name", DEPLOYMENTS)
def test_deployments_are_set_up(name: str, monkeypatch: pytest.MonkeyPatch) -> None:
    spec, container = DEPLOYMENTS[name]["spec"], container_of(DEPLOYMENTS[name])
    (shared,) = of_kind("ConfigMap")
    image = IMAGES[container["image"]]
    own = {one["name"]: one["value"] for one in container["env"]}
    settings = check_settings(monkeypatch, pairs(image, "ENV") | shared["data"] | own)
    check_cow(list(container["args"]))
    assert [secret for secret in own if re.search("KEY|SECRET|PASSWORD|TOKEN|DATABASE_URL", secret)] == []
    assert of_kind("Secret") == [], "they stand in no file"
    labels = spec["template"]["metadata"]["labels"]
    assert spec["selector"]["matchLabels"] == labels
    before = container.get("lifecycle", {}).get("preStop", {}).get("sleep", {}).get("seconds", 0)
    assert spec["template"]["spec"]["terminationGracePeriodSeconds"] > before + longest_stop(settings)
    (port,) = container["ports"]
    assert port["containerPort"] == (settings.port if name == "cow-api" else settings.metrics_port)
    assert container["livenessProbe"]["httpGet"]["port"] == port["name"]
    (volumes,) = texts(image, "VOLUME")
    assert {one["mountPath"] for one in container["volumeMounts"]} == {*json.loads(volumes), "/tmp"}
    assert {one["name"] for one in container["volumeMounts"]} == {
        one["name"] for one in spec["template"]["spec"]["volumes"]
    }
    (budget,) = (one for one in of_kind("PodDisruptionBudget") if one["metadata"]["name"] == name)
    assert budget["spec"]["selector"]["matchLabels"] == labels


def test_jobs_are_commands_and_one_of_them_alone_creates_the_tables() -> None:
    for job in of_kind("Job"):
        container = container_of(job)
        check_cow(list(container["args"]))
        (volumes,) = texts(IMAGES[container["image"]], "VOLUME")
        assert {one["mountPath"] for one in container["volumeMounts"]} == {*json.loads(volumes), "/tmp"}
    (shared,) = of_kind("ConfigMap")
    (migrating,) = (container_of(one) for one in of_kind("Job") if container_of(one)["args"] == ["migrate"])
    assert shared["data"]["COW_MIGRATE"] == "false"
    assert migrating["envFrom"] == container_of(DEPLOYMENTS["cow-api"])["envFrom"]


def ray_groups() -> dict[str, dict[str, Any]]:
    """The groups of nodes of the Ray cluster, and its head."""
    (cluster,) = of_kind("RayCluster")
    return {"head": cluster["spec"]["headGroupSpec"]} | {
        one["groupName"]: one for one in cluster["spec"]["workerGroupSpecs"]
    }


@pytest.mark.parametrize("name", ray_groups())
def test_nodes_of_the_ray_cluster_are_pods(name: str) -> None:
    group, version = ray_groups()[name], kubernetes_validate.latest_version()
    pod = {"apiVersion": "v1", "kind": "Pod", **group["template"]}
    kubernetes_validate.validate(pod, version, strict=True)
    (container,) = pod["spec"]["containers"]
    (volumes,) = texts(IMAGES[container["image"]], "VOLUME")
    mounts = {one["mountPath"]: one["name"] for one in container["volumeMounts"]}
    assert mounts.keys() == {*json.loads(volumes), "/tmp", "/dev/shm"}
    assert set(mounts.values()) == {one["name"] for one in pod["spec"]["volumes"]}
    assert "KUBERAY_GEN_RAY_START_CMD" in container["command"][-1]
    assert group.get("minReplicas", 1) <= group.get("replicas", 1) <= group.get("maxReplicas", 1)


def test_actors_are_those_that_the_nodes_have_room_for(monkeypatch: pytest.MonkeyPatch) -> None:
    groups, (shared,) = ray_groups(), of_kind("ConfigMap")
    (container,) = groups["jobs"]["template"]["spec"]["containers"]
    assert "cow worker" in container["command"][-1]
    own = {one["name"]: one["value"] for one in container["env"]}
    settings = check_settings(monkeypatch, shared["data"] | own)
    assert settings.ray == "auto"
    assert groups["jobs"]["template"]["spec"]["terminationGracePeriodSeconds"] > longest_stop(settings)
    for name, (fewest, most) in settings.ray_actors.items():
        started = groups[name]["rayStartParams"]
        places = int(started["num-cpus"]) if name == "light" else int(started["num-gpus"])
        assert (fewest, most) == (groups[name]["minReplicas"] * places, groups[name]["maxReplicas"] * places)
    assert {groups[name]["rayStartParams"]["num-cpus"] for name in ("head", "jobs", "ati")} == {"0"}
    (cluster,) = of_kind("RayCluster")
    locked = re.findall(r"^ray==(\S+)", (ROOT / "docker" / "locks" / "cpu.txt").read_text(), re.MULTILINE)
    assert locked == [cluster["spec"]["rayVersion"]]


def test_servers_are_scaled_by_one_thing() -> None:
    (servers,) = of_kind("HorizontalPodAutoscaler")
    assert [servers["spec"]["scaleTargetRef"]["name"]] == [*DEPLOYMENTS]
    for name, workload in DEPLOYMENTS.items():
        assert "replicas" not in workload["spec"], f"{name}: each update would set the number back"
        assert container_of(workload)["resources"]["requests"]["cpu"], "a share of which the autoscaler looks at"
    (budget,) = (one for one in of_kind("PodDisruptionBudget") if one["metadata"]["name"] == "cow-api")
    assert budget["spec"]["minAvailable"] < servers["spec"]["minReplicas"], "else no node can be emptied"


def selects(selector: dict[str, Any], labels: dict[str, str]) -> bool:
    said = [
        (labels.get(one["key"]) in one["values"]) == (one["operator"] == "In")
        for one in selector.get("matchExpressions", ())
    ]
    return selector["matchLabels"].items() <= labels.items() and all(said)


@pytest.mark.parametrize("name", ["cow-api", *ray_groups()])
def test_pods_are_reached_where_they_listen_and_reach_what_they_need(name: str) -> None:
    template = DEPLOYMENTS[name]["spec"]["template"] if name in DEPLOYMENTS else ray_groups()[name]["template"]
    labels = template["metadata"]["labels"]
    policies = [one["spec"] for one in of_kind("NetworkPolicy") if selects(one["spec"]["podSelector"], labels)]
    (inward,) = (one for one in policies if one["policyTypes"] == ["Ingress"])
    (outward,) = (one for one in policies if one["policyTypes"] == ["Egress"])
    among = [one for one in policies if one["policyTypes"] == ["Ingress", "Egress"]]
    for rule in [rule for one in among for rule in (*one["ingress"], *one["egress"])]:
        (peer,) = rule.get("from") or rule["to"]
        assert all(selects(peer["podSelector"], one["template"]["metadata"]["labels"]) for one in ray_groups().values())
    assert len(among) == (name != "cow-api"), "nodes of the Ray cluster reach each other, and nobody else does"
    if name in ("cow-api", "jobs"):
        (container,) = template["spec"]["containers"]
        assert [port["port"] for rule in inward["ingress"] for port in rule["ports"]] == [
            port["name"] for port in container["ports"]
        ]
    assert all(rule.get("from") for rule in inward["ingress"]) == (name != "cow-api"), "only servers ask for keys"
    assert {port["port"] for rule in outward["egress"] for port in rule["ports"]} >= {53, 443, 5432}


def test_every_alarm_is_in_the_runbook() -> None:
    assert {rule["alert"] for rule in RULES} == set(re.findall(r"^### (Cow\w+)$", RUNBOOK, re.MULTILINE))
    for rule in RULES:
        assert set(rule) <= {"alert", "expr", "for", "labels", "annotations"}
        assert rule["labels"]["severity"] in ("critical", "warning")
        assert rule["annotations"]["summary"]


def names_in(expression: str) -> set[str]:
    return set(re.findall(r"\b(?:cow|process)_[a-z_]+|\bup\b", expression)) - OF_PROMETHEUS


@pytest.mark.slow
def test_alarms_and_panels_are_of_metrics_that_exist(http: httpx.Client) -> None:
    told = re.findall(r"^# TYPE (\S+) (\S+)", http.get("/metrics").text, re.MULTILINE)
    parts = {"histogram": ("_bucket", "_sum", "_count")}
    metrics = {name + part for name, kind in told for part in parts.get(kind, ("",))}
    panels = [target["expr"] for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]
    for expression in [rule["expr"] for rule in RULES] + panels:
        assert names_in(expression) <= metrics, expression
    shown = {name for expression in panels for name in names_in(expression)}
    assert {name for name in metrics if name.startswith("cow_")} - shown <= {
        name for name in metrics if name.endswith(("_sum", "_count", "_created"))
    }


def test_the_dashboard_has_a_data_source_to_choose() -> None:
    (variable,) = DASHBOARD["templating"]["list"]
    assert (variable["type"], variable["query"]) == ("datasource", "prometheus")
    targets = [target for panel in DASHBOARD["panels"] for target in panel.get("targets", ())]
    assert {target["datasource"]["uid"] for target in targets} == {"${" + variable["name"] + "}"}
