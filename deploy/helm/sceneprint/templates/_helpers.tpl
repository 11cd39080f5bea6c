{{- define "sceneprint.image" -}}
{{- with .Values.image -}}
{{- if .digest -}}
{{ .repository }}@{{ .digest }}
{{- else -}}
{{ .repository }}:{{ .tag | default $.Chart.AppVersion }}
{{- end -}}
{{- end -}}
{{- end }}

{{- define "sceneprint.name" -}}
{{- .Release.Name | trunc 50 | trimSuffix "-" -}}
{{- end }}

{{/* Labels of a part that no upgrade changes, as selectors require: dict root, part */}}
{{- define "sceneprint.selector" -}}
app.kubernetes.io/name: sceneprint
app.kubernetes.io/instance: {{ .root.Release.Name }}
app.kubernetes.io/component: {{ .part }}
{{- end }}

{{- define "sceneprint.labels" -}}
{{ include "sceneprint.selector" . }}
app.kubernetes.io/version: {{ .root.Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .root.Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .root.Chart.Name .root.Chart.Version }}
{{- end }}

{{/* Reject a URL with a password, or of another database: dict name, url. A pattern in the schema
would make Helm print the rejected URL with its password. */}}
{{- define "sceneprint.checkUrl" -}}
{{- if regexMatch "://[^/?@]*:[^@]*@|@.*@|[?&]password=" .url -}}
{{- fail (printf "database.%s must not contain a password: put PGPASSWORD into the secret" .name) -}}
{{- end -}}
{{- if not (regexMatch "^postgres(ql(\\+psycopg)?)?://" .url) -}}
{{- fail (printf "database.%s must be postgresql+psycopg://user@host/database" .name) -}}
{{- end -}}
{{- end }}

{{/* Environment of every pod. It is not a ConfigMap, since the migration runs before it would exist. */}}
{{- define "sceneprint.env" -}}
{{- if not .Values.single.enabled -}}
{{- include "sceneprint.checkUrl" (dict "name" "url" "url" .Values.database.url) -}}
- name: SCENEPRINT_DATABASE_URL
  value: {{ .Values.database.url | quote }}
- name: SCENEPRINT_BLOB_URL
  value: {{ .Values.blobs.url | quote }}
{{- end }}
{{- range $name, $value := .Values.env }}
- name: {{ $name }}
  value: {{ $value | quote }}
{{- end }}
{{- end }}

{{/* Common settings of every pod: dict root, part, values, and the sizes of its folders. */}}
{{- define "sceneprint.pod" -}}
{{- with .root.Values.imagePullSecrets }}
imagePullSecrets:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .root.Values.serviceAccountName }}
serviceAccountName: {{ . }}
{{- end }}
automountServiceAccountToken: false
enableServiceLinks: false
# The pause process collects orphaned processes.
shareProcessNamespace: true
securityContext:
  runAsNonRoot: true
  runAsUser: 10001
  runAsGroup: 10001
  fsGroup: 10001
  seccompProfile:
    type: RuntimeDefault
{{- end }}

{{- define "sceneprint.container" -}}
image: {{ include "sceneprint.image" . }}
imagePullPolicy: {{ .Values.image.pullPolicy }}
securityContext:
  allowPrivilegeEscalation: false
  readOnlyRootFilesystem: true
  capabilities:
    drop: [ALL]
{{- with .Values.secret }}
envFrom:
  - secretRef:
      name: {{ . }}
{{- end }}
{{- end }}

{{- define "sceneprint.mounts" -}}
- name: data
  mountPath: /data
- name: cache
  mountPath: /var/cache/sceneprint
- name: temporary
  mountPath: /tmp
{{- end }}

{{- define "sceneprint.volumes" -}}
- name: data
  {{- if .claim }}
  persistentVolumeClaim:
    claimName: {{ .claim }}
  {{- else }}
  emptyDir:
    sizeLimit: {{ .dataSize }}
  {{- end }}
- name: cache
  emptyDir:
    sizeLimit: 1Gi
- name: temporary
  emptyDir:
    sizeLimit: {{ .temporarySize }}
{{- end }}

{{/* Copy the compiled kernels of the image to a writable folder, so that pods need not compile. */}}
{{- define "sceneprint.kernels" -}}
- name: kernels
  {{- include "sceneprint.container" . | nindent 2 }}
  command: [cp, -a, /var/cache/sceneprint/., /cache/]
  resources:
    requests: {cpu: 50m, memory: 64Mi}
    limits: {cpu: 500m, memory: 128Mi}
  volumeMounts:
    - name: cache
      mountPath: /cache
{{- end }}

{{- define "sceneprint.placement" -}}
{{- with .nodeSelector }}
nodeSelector:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .tolerations }}
tolerations:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- with .affinity }}
affinity:
  {{- toYaml . | nindent 2 }}
{{- end }}
{{- end }}
