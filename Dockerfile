# What flights need, and the main scenario flown once:      docker build -t sortie .
# The tests, after an installation of what they need:       docker run --rm sortie
# A shell, with the runs kept here:                         docker run --rm -it -v "$PWD/runs:/sortie/runs" sortie bash
FROM python:3.12-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git make \
    && rm -rf /var/lib/apt/lists/*
# torch without CUDA: --build-arg PIP_EXTRA_INDEX_URL=…, the index for CPUs that PyTorch's install page names
ARG PIP_EXTRA_INDEX_URL
ENV PATH="/sortie/.venv/bin:$PATH"
WORKDIR /sortie
COPY . .
RUN make sortie
CMD ["make", "test"]
