{{- /* The name of all objects, and before the number that of each router. Short enough for the labels of pods. */ -}}
{{- define "sgc.name" -}}
{{- $name := .Values.nameOverride | default (ternary .Release.Name (printf "%s-%s" .Release.Name .Chart.Name) (contains .Chart.Name .Release.Name)) -}}
{{- $name | trunc 40 | trimSuffix "-" -}}
{{- end -}}

{{- define "sgc.selector" -}}
app.kubernetes.io/name: {{ .Chart.Name }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "sgc.labels" -}}
helm.sh/chart: {{ .Chart.Name }}-{{ .Chart.Version }}
{{ include "sgc.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
{{- end -}}

{{- define "sgc.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end -}}

{{- define "sgc.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities:
  drop: [ALL]
{{- end -}}

{{- /* The sgc.toml of a router: call with a dict of root and number. */ -}}
{{- define "sgc.toml" -}}
{{- $name := include "sgc.name" .root -}}
{{- $values := .root.Values -}}
{{- $listen := list -}}
{{- if $values.listen.quic.enabled -}}
{{- $listen = append $listen (printf "quic://0.0.0.0:%d" (int $values.listen.quic.port)) -}}
{{- end -}}
{{- if $values.listen.tls.enabled -}}
{{- $listen = append $listen (printf "tls://0.0.0.0:%d" (int $values.listen.tls.containerPort)) -}}
{{- end -}}
{{- if not $listen -}}
{{- fail "a router listens at `listen.quic` or `listen.tls`, or at both" -}}
{{- end -}}
{{- $routers := $values.routers -}}
{{- range $lower := until (int .number) -}}
{{- if $values.listen.quic.enabled -}}
{{- $routers = append $routers (printf "quic://%s-%d.%s:%d" $name $lower $name (int $values.listen.quic.port)) -}}
{{- else -}}
{{- $routers = append $routers (printf "tls://%s-%d.%s:%d" $name $lower $name (int $values.listen.tls.containerPort)) -}}
{{- end -}}
{{- end -}}
identity = "/var/lib/sgc/router.identity"

[node]
routers = {{ $routers | toJson }}

[router]
listen = {{ $listen | toJson }}
{{- with $values.peerRate }}
peer_rate = {{ . | quote }}
{{- end }}

[metrics]
listen = "0.0.0.0:{{ int $values.metrics.port }}"
{{- with $values.extraConfig }}

{{ . | trim }}
{{- end }}
{{ end -}}
