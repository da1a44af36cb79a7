"""The plugin would collect scenario files: these are broken on purpose."""

collect_ignore_glob = ["broken/*"]
