{{- /* Namespaces of the storage's services, as a JSON array. */ -}}
{{- define "rayherd.stores" -}}
{{- $namespaces := dict -}}
{{- range .Values.storage -}}
{{- with .service -}}
{{- $_ := set $namespaces .namespace true -}}
{{- end -}}
{{- end -}}
{{- keys $namespaces | sortAlpha | toJson -}}
{{- end -}}

{{- /* The priority class of the operator's pods, if they have one. A class's value cannot be changed, so its name has it: another value is
another object. */ -}}
{{- define "rayherd.priorityClass" -}}
{{- if .Values.priorityClassName -}}
{{- .Values.priorityClassName -}}
{{- else if .Values.priority -}}
{{- printf "%s-operator-%d" .Release.Name (int64 .Values.priority) | replace "--" "-minus-" -}}
{{- end -}}
{{- end -}}

{{- /* Secrets that images are pulled with, as a list of a pod. */ -}}
{{- define "rayherd.pullSecrets" -}}
{{- $names := list -}}
{{- range .Values.imagePullSecrets -}}
{{- $names = append $names (dict "name" .) -}}
{{- end -}}
{{- toJson $names -}}
{{- end -}}
