{{/* The release's name as that of a service, which has no dots and begins with a letter. */}}
{{- define "revisit.name" -}}
{{- $name := .Release.Name | replace "." "-" -}}
{{- if regexMatch "^[0-9]" $name -}}
{{- $name = print "revisit-" $name -}}
{{- end -}}
{{- $name | trunc 52 | trimSuffix "-" -}}
{{- end -}}

{{- define "revisit.selector" -}}
app.kubernetes.io/name: {{ .Chart.Name }}
app.kubernetes.io/instance: {{ .Release.Name }}
{{- end -}}

{{- define "revisit.labels" -}}
{{ include "revisit.selector" . }}
app.kubernetes.io/version: {{ .Chart.AppVersion | quote }}
app.kubernetes.io/managed-by: {{ .Release.Service }}
helm.sh/chart: {{ printf "%s-%s" .Chart.Name .Chart.Version }}
{{- end -}}

{{- define "revisit.image" -}}
{{ .Values.image.repository }}:{{ .Values.image.tag | default .Chart.AppVersion }}
{{- end -}}

{{- define "revisit.shared" -}}
{{- if not (has .Values.store.kind (list "sqlite" "postgresql")) -}}
{{- fail "store.kind: allowed are sqlite and postgresql" -}}
{{- end -}}
{{- $guarded := and .Values.tls.existingSecret .Values.policy.existingConfigMap (or .Values.tls.clientCaSecret .Values.policy.tokenIssuer) -}}
{{- if not (or $guarded .Values.insecureAllowRemote) -}}
{{- fail "tls.existingSecret, policy.existingConfigMap, and tls.clientCaSecret or policy.tokenIssuer are missing; or, if nobody else can reach the servers, set insecureAllowRemote" -}}
{{- end -}}
{{- if eq .Values.store.kind "postgresql" -}}
{{- if not .Values.store.postgresql.existingSecret -}}
{{- fail "store.postgresql.existingSecret: name the secret with the database's URLs" -}}
{{- end -}}
true
{{- end -}}
{{- end -}}

{{/* Nobody in particular, who may write nothing but volumes. */}}
{{- define "revisit.podSecurity" -}}
runAsNonRoot: true
runAsUser: 10001
runAsGroup: 10001
fsGroup: 10001
fsGroupChangePolicy: OnRootMismatch
seccompProfile: {type: RuntimeDefault}
{{- end -}}

{{- define "revisit.containerSecurity" -}}
allowPrivilegeEscalation: false
readOnlyRootFilesystem: true
capabilities: {drop: [ALL]}
{{- end -}}

{{/* The pods of the servers, whoever makes them. */}}
{{- define "revisit.pod" -}}
metadata:
  labels:
    {{- include "revisit.labels" . | nindent 4 }}
    app.kubernetes.io/component: server
    {{- with .Values.podLabels }}{{ toYaml . | nindent 4 }}{{ end }}
  annotations:
    # Other settings, other pods.
    checksum/settings: {{ include (print $.Template.BasePath "/settings.yaml") . | sha256sum }}
    {{- with .Values.podAnnotations }}{{ toYaml . | nindent 4 }}{{ end }}
spec:
  serviceAccountName: {{ include "revisit.name" . }}
  automountServiceAccountToken: false
  enableServiceLinks: false
  securityContext:
    {{- include "revisit.podSecurity" . | nindent 4 }}
  {{- with .Values.imagePullSecrets }}
  imagePullSecrets: {{ toYaml . | nindent 4 }}
  {{- end }}
  # The notice, the drain, and what follows them.
  terminationGracePeriodSeconds: {{ add .Values.drainNoticeSeconds .Values.drainTimeoutSeconds 15 }}
  {{- if .Values.affinity }}
  affinity: {{ toYaml .Values.affinity | nindent 4 }}
  {{- else if include "revisit.shared" . }}
  affinity:
    podAntiAffinity:
      preferredDuringSchedulingIgnoredDuringExecution:
      - weight: 100
        podAffinityTerm:
          topologyKey: kubernetes.io/hostname
          labelSelector:
            matchLabels:
              {{- include "revisit.selector" . | nindent 14 }}
              app.kubernetes.io/component: server
  {{- end }}
  {{- with .Values.nodeSelector }}
  nodeSelector: {{ toYaml . | nindent 4 }}
  {{- end }}
  {{- with .Values.tolerations }}
  tolerations: {{ toYaml . | nindent 4 }}
  {{- end }}
  containers:
  - name: revisitd
    image: {{ include "revisit.image" . }}
    imagePullPolicy: {{ .Values.image.pullPolicy }}
    args: [--config, /etc/revisit/settings/revisitd.conf]
    env:
    # Variables of the image count before the file.
    - {name: REVISIT_LISTEN, value: "0.0.0.0:50051"}
    {{- if include "revisit.shared" . }}
    - name: REVISIT_STORE
      valueFrom:
        secretKeyRef:
          name: {{ .Values.store.postgresql.existingSecret }}
          key: {{ .Values.store.postgresql.urlKey }}
    - name: POD_IP
      valueFrom: {fieldRef: {fieldPath: status.podIP}}
    - {name: REVISIT_ADVERTISE_ADDRESS, value: "$(POD_IP):50051"}
    {{- else }}
    - {name: REVISIT_STORE, value: /var/lib/revisit/store}
    {{- end }}
    ports:
    - {name: grpc, containerPort: 50051}
    - {name: admin, containerPort: {{ .Values.adminPort }}}
    # Alive from before the store is opened, and whatever the disk or the database: a
    # restart would mend neither.
    livenessProbe:
      httpGet: {path: /livez, port: admin}
      periodSeconds: 10
      timeoutSeconds: 5
      failureThreshold: 6
    readinessProbe:
      httpGet: {path: /readyz, port: admin}
      periodSeconds: 5
      timeoutSeconds: 3
    securityContext:
      {{- include "revisit.containerSecurity" . | nindent 6 }}
    resources: {{ toYaml .Values.resources | nindent 6 }}
    volumeMounts:
    - {name: settings, mountPath: /etc/revisit/settings, readOnly: true}
    - {name: tmp, mountPath: /tmp}
    {{- if not (include "revisit.shared" .) }}
    - {name: store, mountPath: /var/lib/revisit}
    {{- end }}
    {{- if .Values.tls.existingSecret }}
    - {name: tls, mountPath: /etc/revisit/tls, readOnly: true}
    {{- end }}
    {{- if .Values.tls.clientCaSecret }}
    - {name: client-ca, mountPath: /etc/revisit/client-ca, readOnly: true}
    {{- end }}
    {{- if .Values.policy.existingConfigMap }}
    - {name: policy, mountPath: /etc/revisit/policy, readOnly: true}
    {{- end }}
  volumes:
  - name: settings
    configMap: {name: {{ include "revisit.name" . }}}
  - name: tmp
    emptyDir: {}
  {{- with .Values.tls.existingSecret }}
  - name: tls
    secret: {secretName: {{ . }}, defaultMode: 0440}
  {{- end }}
  {{- with .Values.tls.clientCaSecret }}
  - name: client-ca
    secret: {secretName: {{ . }}, defaultMode: 0440}
  {{- end }}
  {{- with .Values.policy.existingConfigMap }}
  - name: policy
    configMap: {name: {{ . }}}
  {{- end }}
{{- end -}}
