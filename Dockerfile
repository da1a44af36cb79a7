# Everything installed, and the main scenario flown once:   docker build -t sortie .
# The tests:                                                docker run --rm sortie
# A shell, with the runs kept here:                         docker run --rm -it -v "$PWD/runs:/sortie/runs" sortie bash
FROM python:3.12-slim
RUN apt-get update \
    && apt-get install --yes --no-install-recommends git make \
    && rm -rf /var/lib/apt/lists/*
# PyTorch's own index: torch without CUDA. Leave this line out for CUDA.
ENV PIP_EXTRA_INDEX_URL=https://download.pytorch.org/whl/cpu
ENV PATH="/sortie/.venv/bin:$PATH"
WORKDIR /sortie
COPY . .
RUN make sortie
CMD ["make", "test"]
