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

{{- /* Secrets that images are pulled with, as a list of a pod. */ -}}
{{- define "rayherd.pullSecrets" -}}
{{- $names := list -}}
{{- range .Values.imagePullSecrets -}}
{{- $names = append $names (dict "name" .) -}}
{{- end -}}
{{- toJson $names -}}
{{- end -}}
