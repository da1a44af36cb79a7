"""The ranking of policies on a fixed, versioned suite of conditions (`sortie rank`)."""
