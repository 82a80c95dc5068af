"""What the chart's templates say with sets of values, what its schema refuses, and whether its README names all values."""

import json
import re
import subprocess
import sys

import yaml

HELM, CHART = sys.argv[1:3]
OWN, JOBS, STORE = "rayherd", "studio", "rayherd-store"
BEGIN, END = "<!-- values: written by tests/chart/run write -->", "<!-- end of values -->"
MINIO = {
    "minio.enabled": "true",
    "storage.default.service.name": "rayherd-minio",
    "storage.default.service.namespace": OWN,
}


def helm(*arguments):
    done = subprocess.run([HELM, *arguments], capture_output=True, text=True)
    return done.returncode, done.stdout, done.stderr


def flags(values):
    return [part for path, value in values.items() for part in ("--set", f"{path}={value}")]


class Rendered:
    """The objects that the templates make of some values."""

    def __init__(self, values):
        code, out, err = helm("template", "rayherd", CHART, "--namespace", OWN, *flags(values))
        assert code == 0, f"helm template with {values}: {err}"
        self.all = [d for d in yaml.safe_load_all(out) if d]
        for d in self.all:
            assert d.get("apiVersion") and d.get("kind") and d["metadata"].get("name"), d
        names = [self.key(d) for d in self.all]
        assert len(names) == len(set(names)), f"two objects of one name with {values}: {sorted(names)}"

    @staticmethod
    def key(d):
        return d["kind"], d["metadata"].get("namespace", OWN), d["metadata"]["name"]

    def kinds(self, kind):
        return [d for d in self.all if d["kind"] == kind]

    def one(self, kind, name, namespace=OWN):
        found = [d for d in self.all if self.key(d) == (kind, namespace, name)]
        assert len(found) == 1, f"{kind} {namespace}/{name} among {[self.key(d) for d in self.all]}"
        return found[0]

    def pods(self):
        """(what, pod's spec) of everything that runs."""
        for d in self.all:
            if d["kind"] == "Pod":
                yield self.key(d), d["spec"]
            elif d["kind"] in ("Deployment", "StatefulSet", "Job"):
                yield self.key(d), d["spec"]["template"]["spec"]


def grants(role):
    """{(group, resource): verbs} of a role."""
    granted = {}
    for rule in role["rules"]:
        for group in rule["apiGroups"]:
            for resource in rule["resources"]:
                granted.setdefault((group, resource), set()).update(rule["verbs"])
    return granted


def always(r, values):
    """What holds whatever the values are."""
    for what, pod in r.pods():
        security, server = pod["securityContext"], what[2] == "rayherd-minio"
        assert security["seccompProfile"] == {"type": "RuntimeDefault"}, what
        assert security["runAsNonRoot"] is (security["runAsUser"] != 0), what
        assert server or security["runAsUser"] == 65532, what
        for c in pod["containers"]:
            own = c["securityContext"]
            assert own["readOnlyRootFilesystem"] is True and own["allowPrivilegeEscalation"] is False, what
            assert own["capabilities"] == {"drop": ["ALL"]}, what
            assert c["image"] and c["imagePullPolicy"] in ("Always", "IfNotPresent", "Never"), what
            for e in c.get("env", []):
                assert isinstance(e.get("value", ""), str), f"{what}: {e} is no text"
    # no right in the whole cluster but what is named here, and never a star
    for role in r.kinds("ClusterRole") + r.kinds("Role"):
        for (group, resource), verbs in grants(role).items():
            assert "*" not in (group, resource) and "*" not in verbs, role
    # each binding has its role and its account
    accounts = {(d["metadata"].get("namespace", OWN), d["metadata"]["name"]) for d in r.kinds("ServiceAccount")}
    for d in r.kinds("RoleBinding") + r.kinds("ClusterRoleBinding"):
        ref = d["roleRef"]
        r.one(ref["kind"], ref["name"], d["metadata"].get("namespace", OWN) if ref["kind"] == "Role" else OWN)
        for s in d["subjects"]:
            assert (s["namespace"], s["name"]) in accounts, d
    for what, pod in r.pods():
        if pod.get("serviceAccountName"):
            assert (OWN, pod["serviceAccountName"]) in accounts, what
    # a profile is what the operator reads
    for d in r.kinds("ConfigMap"):
        if "profile.yaml" in d["data"]:
            profile = yaml.safe_load(d["data"]["profile.yaml"])
            assert profile["bucket"] and (profile.get("service") or profile.get("endpoints")), d
    # services select pods that are there, or that will be workers
    deployment = r.one("Deployment", "rayherd-operator")
    labels = deployment["spec"]["template"]["metadata"]["labels"]
    assert deployment["spec"]["selector"]["matchLabels"].items() <= labels.items()
    assert "app.kubernetes.io/name" in labels and labels["app.kubernetes.io/name"] == "rayherd"
    for d in r.kinds("StatefulSet") + r.kinds("Job"):
        assert d["spec"]["template"]["metadata"]["labels"]["app.kubernetes.io/name"] != "rayherd", f"{d}: the operator's"


def defaults(r, _):
    spec = r.one("Deployment", "rayherd-operator")["spec"]
    assert spec["replicas"] == 2 and spec["template"]["spec"]["serviceAccountName"] == "rayherd"
    # above workers, and not both on one node
    name = spec["template"]["spec"]["priorityClassName"]
    own = r.one("PriorityClass", name)
    assert own["value"] == 1000000 and own["globalDefault"] is False and str(own["value"]) in name, own
    assert "preemptionPolicy" not in own, "it takes the place of what is less important"
    (spread,) = spec["template"]["spec"]["topologySpreadConstraints"]
    assert spread["whenUnsatisfiable"] == "DoNotSchedule" and spread["topologyKey"] == "kubernetes.io/hostname", spread
    assert spread["labelSelector"]["matchLabels"] == spec["selector"]["matchLabels"], spread
    r.one("PodDisruptionBudget", "rayherd-operator")
    policies = r.kinds("NetworkPolicy")
    assert [p["metadata"]["name"] for p in policies] == ["rayherd-operator"], policies
    assert [x["port"] for i in policies[0]["spec"]["ingress"] for x in i["ports"]] == ["tasks", "metrics"]
    assert not r.kinds("StatefulSet") and not r.kinds("PodMonitor")
    granted = grants(r.one("ClusterRole", "rayherd-operator"))
    assert granted[("", "secrets")] == {"get"} and ("discovery.k8s.io", "endpointslices") in granted
    assert grants(r.one("ClusterRole", "rayherd-reviews")) == {("authentication.k8s.io", "tokenreviews"): {"create"}}
    ports = {p["name"]: p["containerPort"] for p in spec["template"]["spec"]["containers"][0]["ports"]}
    for name in ("rayherd-operator", "rayherd-metrics"):
        for p in r.one("Service", name)["spec"]["ports"]:
            assert p["port"] == ports[p["targetPort"]], name
    # people: who views may not change, who edits may do what a job's owner does and nothing to its status, which is the operator's
    aggregate = "rbac.authorization.k8s.io/aggregate-to-"
    people = {
        "viewer": ({"renderjobs", "renderjobs/status"}, {"get", "list", "watch"}, {"view"}),
        "editor": ({"renderjobs"}, {"create", "update", "patch", "delete", "deletecollection"}, {"edit", "admin"}),
    }
    for name, (resources, verbs, roles) in people.items():
        role = r.one("ClusterRole", f"rayherd-{name}")
        assert grants(role) == {("rayherd.io", resource): verbs for resource in resources}, role
        assert role["metadata"]["labels"] == {f"{aggregate}{to}": "true" for to in roles}, role
    # helm test's pod can do what it does
    assert grants(r.one("Role", "rayherd-trial"))[("rayherd.io", "renderjobs")] >= {"create", "patch", "get", "delete"}
    r.one("Role", "rayherd-trial-servers", STORE)


def single(r, _):
    assert r.one("Deployment", "rayherd-operator")["spec"]["replicas"] == 1
    assert not r.kinds("PodDisruptionBudget"), "one operator could never be drained"


def namespaced(r, _):
    # a class has no namespace: whoever installs makes it, as the cluster roles, and the operator has no right to it
    assert len(r.kinds("PriorityClass")) == 1
    assert not [g for d in r.kinds("Role") + r.kinds("ClusterRole") for g in grants(d) if "scheduling" in g[0]]
    cluster = r.kinds("ClusterRole")
    names = sorted(d["metadata"]["name"] for d in cluster)
    assert names == ["rayherd-editor", "rayherd-reviews", "rayherd-viewer"], names
    for d in cluster:
        assert ("", "secrets") not in grants(d) and ("", "pods") not in grants(d), d
    assert [d["metadata"]["name"] for d in r.kinds("ClusterRoleBinding")] == ["rayherd-reviews"]
    granted = grants(r.one("Role", "rayherd-operator", JOBS))
    assert granted[("", "secrets")] == {"get"} and granted[("", "pods")] >= {"create", "patch", "delete"}
    assert granted[("rayherd.io", "renderjobs")] >= {"list", "watch"}
    r.one("RoleBinding", "rayherd-operator", JOBS)
    assert grants(r.one("Role", "rayherd-servers", STORE)) == {("discovery.k8s.io", "endpointslices"): {"get", "list"}}
    # it labels its own pod
    assert grants(r.one("Role", "rayherd-own"))[("", "pods")] == {"get", "patch"}
    env = r.one("Deployment", "rayherd-operator")["spec"]["template"]["spec"]["containers"][0]["env"]
    assert {"name": "RAYHERD_WATCH_NAMESPACE", "value": JOBS} in env
    assert {"name": "RAYHERD_SCENE_DAYS", "value": "30"} in env


def policies(r, _):
    def within(namespace):
        return {"namespaceSelector": {"matchLabels": {"kubernetes.io/metadata.name": namespace}}}

    operators = {"matchLabels": {"app.kubernetes.io/name": "rayherd", "app.kubernetes.io/instance": "rayherd"}}
    worker_pods = {"matchLabels": {"app.kubernetes.io/name": "rayherd-worker"}}
    workers = r.one("NetworkPolicy", "rayherd-workers", JOBS)["spec"]
    assert workers["podSelector"] == worker_pods, workers
    assert workers["policyTypes"] == ["Ingress", "Egress"] and "ingress" not in workers
    assert [p["port"] for e in workers["egress"] for p in e.get("ports", [])] == [53, 53, "tasks", 9000]
    # a peer that lacks is everybody: the name service's alone
    assert [e.get("to") for e in workers["egress"]] == [
        None,
        [{**within(OWN), "podSelector": operators}],
        [within(STORE)],
        [{"ipBlock": {"cidr": "10.0.0.0/8"}}],
    ], workers
    operator = r.one("NetworkPolicy", "rayherd-operator")["spec"]
    assert operator["podSelector"] == operators and operator["policyTypes"] == ["Ingress"], operator
    # workers of every namespace, and of the metrics everybody
    assert [i.get("from") for i in operator["ingress"]] == [
        [{"namespaceSelector": {}, "podSelector": worker_pods}],
        None,
    ], operator


def no_policies(r, _):
    assert not r.kinds("NetworkPolicy")


def outside(r, _):
    profile = yaml.safe_load(r.one("ConfigMap", "rayherd-storage-default")["data"]["profile.yaml"])
    assert "service" not in profile and profile["endpoints"] == [{"url": "https://s3.example.com"}]
    assert (profile["prefix"], profile["region"]) == ("renders", "eu-north-1")
    assert not [d for d in r.kinds("Role") if d["metadata"]["name"].endswith("-servers")]


def identity(r, _):
    assert r.one("ServiceAccount", "rayherd")["metadata"]["annotations"] == {"cloud/role": "operator"}
    workers = r.one("ServiceAccount", "renderer", JOBS)
    assert workers["metadata"]["annotations"] == {"cloud/role": "worker"}
    assert workers["automountServiceAccountToken"] is False
    profile = yaml.safe_load(r.one("ConfigMap", "rayherd-storage-default")["data"]["profile.yaml"])
    assert profile["identity"] is True and profile["serviceAccount"] == "renderer"
    env = r.one("Deployment", "rayherd-operator")["spec"]["template"]["spec"]["containers"][0]["env"]
    assert {"name": "AWS_ENDPOINT_URL_STS", "value": "https://sts.example.com"} in env


def distributed(r, _):
    profile = yaml.safe_load(r.one("ConfigMap", "rayherd-storage-default")["data"]["profile.yaml"])
    assert profile["distributed"] is True and "servers" not in profile["service"]


def placed(r, _):
    pod = r.one("Deployment", "rayherd-operator")["spec"]["template"]
    assert pod["metadata"]["annotations"] == {"team": "render"}
    spec = pod["spec"]
    assert spec["nodeSelector"] == {"role": "infra"} and spec["priorityClassName"] == "high"
    assert not r.kinds("PriorityClass"), "theirs is used"
    assert spec["tolerations"] == [{"key": "infra", "operator": "Exists"}]
    for what, pod in r.pods():
        assert pod["imagePullSecrets"] == [{"name": "one"}, {"name": "two"}], what


def other_priority(r, _):
    # another value is another object: a class's own cannot be changed by an upgrade
    (own,) = r.kinds("PriorityClass")
    assert own["value"] == -5 and own["metadata"]["name"] == "rayherd-operator-minus-5", own
    assert r.one("Deployment", "rayherd-operator")["spec"]["template"]["spec"]["priorityClassName"] == own["metadata"]["name"]


def no_priority(r, _):
    assert not r.kinds("PriorityClass")
    assert "priorityClassName" not in r.one("Deployment", "rayherd-operator")["spec"]["template"]["spec"]


def monitoring(r, _):
    monitor = r.one("PodMonitor", "rayherd")
    assert monitor["metadata"]["labels"] == {"release": "prometheus"}
    assert monitor["spec"]["podMetricsEndpoints"][0]["port"] == "metrics"
    alerts = [a["alert"] for g in r.one("PrometheusRule", "rayherd")["spec"]["groups"] for a in g["rules"]]
    own = [a["alert"] for g in yaml.safe_load(open(f"{CHART}/monitoring/rules.yaml"))["groups"] for a in g["rules"]]
    assert alerts == own and len(alerts) >= 6, alerts
    yaml.safe_load(r.one("ConfigMap", "rayherd-dashboard")["data"]["rayherd.json"])["panels"]


def no_trial(r, _):
    assert not [d for d in r.all if "trial" in d["metadata"]["name"]]


def minio(r, values):
    servers, port = int(values.get("minio.servers", 3)), int(values.get("minio.port", 9000))
    service = r.one("Service", "rayherd-minio")["spec"]
    assert service["clusterIP"] == "None" and service["ports"][0]["port"] == port
    server = r.one("StatefulSet", "rayherd-minio")["spec"]
    assert server["serviceName"] == "rayherd-minio" and server["replicas"] == servers
    pod = server["template"]["spec"]
    assert service["selector"] == server["selector"]["matchLabels"] == server["template"]["metadata"]["labels"]
    anti = pod["affinity"]["podAntiAffinity"]["requiredDuringSchedulingIgnoredDuringExecution"][0]
    assert anti["topologyKey"] == "kubernetes.io/hostname" and anti["labelSelector"]["matchLabels"] == service["selector"]
    container = pod["containers"][0]
    assert container["args"] == ["server", "--address", f":{port}", "/data"]
    assert container["envFrom"] == [{"secretRef": {"name": "rayherd-minio"}}]
    paths = {v["name"] for v in pod["volumes"]} | {c["metadata"]["name"] for c in server.get("volumeClaimTemplates", [])}
    assert {m["name"] for m in container["volumeMounts"]} == paths
    # the buckets' hook asks each server by the name that the operator knows it by
    job = r.one("Job", "rayherd-minio-buckets")
    assert job["metadata"]["annotations"]["helm.sh/hook"] == "post-install,post-upgrade"
    arguments = job["spec"]["template"]["spec"]["containers"][0]["args"]
    assert arguments == ["buckets"] + [
        f"http://rayherd-minio-{i}.rayherd-minio.{OWN}.svc:{port}" for i in range(servers)
    ], arguments
    env = {e["name"]: e for e in job["spec"]["template"]["spec"]["containers"][0]["env"]}
    assert env["RAYHERD_BUCKETS"]["value"] == "rayherd"
    assert env["AWS_ACCESS_KEY_ID"]["valueFrom"]["secretKeyRef"]["name"] == "rayherd-minio"


def minio_claims(r, values):
    minio(r, values)
    claim = r.one("StatefulSet", "rayherd-minio")["spec"]["volumeClaimTemplates"][0]["spec"]
    assert claim["storageClassName"] == "local" and claim["resources"]["requests"]["storage"] == "2Ti"


def minio_folder(r, values):
    minio(r, values)
    server = r.one("StatefulSet", "rayherd-minio")["spec"]
    assert "volumeClaimTemplates" not in server
    volumes = {v["name"]: v for v in server["template"]["spec"]["volumes"]}
    assert volumes["data"]["hostPath"]["path"] == "/mnt/minio"


# name: values, what is asserted
SETS = {
    "defaults": ({}, defaults),
    "one operator": ({"replicas": 1}, single),
    "one namespace": ({"watchNamespace": JOBS, "trial.namespace": JOBS}, namespaced),
    "policies of workers": (
        {"networkPolicy.jobNamespaces": "{studio}", "networkPolicy.storageCIDRs": "{10.0.0.0/8}"},
        policies,
    ),
    "no policies": ({"networkPolicy.enabled": "false"}, no_policies),
    "storage outside": (
        {
            "storage.default.endpoints[0].url": "https://s3.example.com",
            "storage.default.service": "null",
            "storage.default.prefix": "renders",
            "storage.default.region": "eu-north-1",
        },
        outside,
    ),
    "a cloud's identity": (
        {
            "storage.default.endpoints[0].url": "https://s3.example.com",
            "storage.default.service": "null",
            "storage.default.identity": "true",
            "storage.default.serviceAccount": "renderer",
            "serviceAccount.annotations.cloud/role": "operator",
            "workerAccount.name": "renderer",
            "workerAccount.namespaces": "{studio}",
            "workerAccount.annotations.cloud/role": "worker",
            "env[0].name": "AWS_ENDPOINT_URL_STS",
            "env[0].value": "https://sts.example.com",
        },
        identity,
    ),
    "distributed": ({"storage.default.distributed": "true", "storage.default.service.servers": "null"}, distributed),
    "where it runs": (
        {
            "podAnnotations.team": "render",
            "nodeSelector.role": "infra",
            "priorityClassName": "high",
            "tolerations[0].key": "infra",
            "tolerations[0].operator": "Exists",
            "imagePullSecrets": "{one,two}",
            **MINIO,
        },
        placed,
    ),
    "another priority": ({"priority": -5}, other_priority),
    "no priority": ({"priority": 0}, no_priority),
    "monitoring": ({"monitoring.enabled": "true", "monitoring.labels.release": "prometheus"}, monitoring),
    "no trial": ({"trial.enabled": "false"}, no_trial),
    "minio": (MINIO, minio),
    "minio, claims": (
        {**MINIO, "minio.servers": 5, "storage.default.service.servers": 5, "minio.volume.storageClass": "local",
         "minio.volume.size": "2Ti", "minio.port": 9001, "storage.default.service.port": 9001},
        minio_claims,
    ),
    "minio, a folder": ({**MINIO, "minio.volume.hostPath": "/mnt/minio", "minio.runAsUser": 0}, minio_folder),
}

# values, what the error must say
REFUSED = [
    ({"replicas": "none"}, "replicas"),
    ({"replicas": 0}, "replicas"),
    ({"sceneDays": -1}, "sceneDays"),
    ({"priority": 2000000000}, "priority"),
    ({"priority": "high"}, "priority"),
    ({"imagePullPolicy": "Sometimes"}, "imagePullPolicy"),
    ({"imagee": "x"}, "imagee"),
    ({"storage.default.bucket": "x"}, "bucket"),
    ({"storage.default.buckets": "xyz"}, "buckets"),
    ({"storage.default.service": "null"}, "service"),
    ({"storage.default.service.servers": "null"}, "servers"),
    ({"storage.default.endpoints[0].url": "s3.example.com"}, "url"),
    ({"networkPolicy.storageCIDRs": "{10.0.0.0}"}, "storageCIDRs"),
    ({"podAnnotations.count": "3"}, "podAnnotations"),
    ({"minio.volume.size": "much"}, "size"),
    ({"minio.volume.hostPath": "data"}, "hostPath"),
    ({"minio.enabled": "true"}, "storage.default.service.name=rayherd-minio"),
    ({**MINIO, "minio.servers": 4}, "the same number"),
    ({**MINIO, "minio.port": 9001}, "port"),
    ({**MINIO, "storage.default.distributed": "true"}, "distributed"),
]


def described():
    """(path, default as it stands, description) of each value of values.yaml, in its order."""
    found, above, parents = [], [], []
    for line in open(f"{CHART}/values.yaml"):
        line = line.rstrip("\n")
        if not line.strip():
            above = []
            continue
        indent, text = len(line) - len(line.lstrip()), line.strip()
        if text.startswith("#"):
            above.append(text.lstrip("# "))
            continue
        key, value = re.fullmatch(r"([A-Za-z]+):\s*(.*)", text).groups()
        parents = [p for p in parents if p[0] < indent]
        path = ".".join([p[1] for p in parents] + [key])
        if value:
            found.append((path, value, " ".join(above)))
        else:
            parents.append((indent, key))
            if above:
                found.append((path, "", " ".join(above)))
        above = []
    return found


def table():
    lines = ["| value | default | what it is |", "|---|---|---|"]
    for path, default, text in described():
        default = f"`{default}`" if default else ""
        lines.append(f"| `{path}` | {default} | {text.replace('|', chr(92) + '|')} |")
    return "\n".join(lines)


def flat(values, prefix=""):
    for key, value in values.items():
        path = f"{prefix}{key}"
        yield path
        if isinstance(value, dict) and not path.startswith("storage.default."):
            yield from flat(value, path + ".")


def readme(write):
    path = f"{CHART}/README.md"
    text = open(path).read()
    head, rest = text.split(BEGIN)
    _, tail = rest.split(END)
    wanted = f"{head}{BEGIN}\n{table()}\n{END}{tail}"
    if write:
        open(path, "w").write(wanted)
    else:
        assert text == wanted, "the README's table of values is old: tests/chart/run write"
    for name, _, said in described():
        assert said, f"{name} has no comment in values.yaml"
    known = {p for p, _, _ in described()}
    leaves = [p for p in flat(yaml.safe_load(open(f"{CHART}/values.yaml")))]
    for leaf in leaves:
        inside = any(leaf.startswith(k + ".") or k.startswith(leaf + ".") for k in known)
        assert leaf in known or inside, f"{leaf} is in no line of the table"
    # each field that a profile may have is written about
    schema = json.load(open(f"{CHART}/values.schema.json"))
    for name in schema["properties"]["storage"]["additionalProperties"]["properties"]:
        assert f"`{name}`" in tail, f"a profile's {name} is not in the README"
    # and each value is in the schema
    for top in yaml.safe_load(open(f"{CHART}/values.yaml")):
        assert top in schema["properties"], f"{top} is not in values.schema.json"


def main():
    if sys.argv[3:] == ["write"]:
        return readme(True)
    if sys.argv[3:4] == ["sets"]:
        release, namespace = sys.argv[4:]
        names = {MINIO["storage.default.service.name"]: f"{release}-minio", OWN: namespace}
        for values, _ in SETS.values():
            print(",".join(f"{path}={names.get(value, value)}" for path, value in values.items()))
        return
    code, out, err = helm("lint", "--strict", CHART)
    assert code == 0 and "0 chart(s) failed" in out, f"helm lint: {out}{err}"
    for name, (values, check) in SETS.items():
        rendered = Rendered(values)
        try:
            always(rendered, values)
            check(rendered, values)
        except AssertionError as e:
            raise AssertionError(f"{name}: {e}") from e
    for values, part in REFUSED:
        code, _, err = helm("template", "rayherd", CHART, "--namespace", OWN, *flags(values))
        assert code != 0, f"{values} is not refused"
        assert part in err, f"{values}: no {part} in {err}"
    readme(False)
    print(f"chart: lint, {len(SETS)} sets of values, {len(REFUSED)} that are refused, README")


main()
