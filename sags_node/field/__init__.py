"""The model of SAGS (arXiv 2510.27318) in torch.

To be read in this order: `hexplane`, `sampling`, `decoder`, `deformation`, `drawing`, `losses`, `model`,
`window`. If the cells are on a GPU, all else is, too, and `canvas` draws it. `twins` chooses the kernels.

A model is canonical Gaussians in raw rows [N, 14] (`model.columns`) and a field that deforms them:

    hexplane = HexPlane(box, t0_ns, slot_ns, slots)                  features of (x, y, z, t)
    decoder = Decoder(hexplane.features, tokens)                     features -> changes of a row
    field = NodeField(Deltas(hexplane, decoder), nodes)              or PointField(Deltas(...))
    model = WindowModel(rows, field)                                 or DeformableModel: of a clip
    decoder.awaken(seed)                                             WindowModel: before it learns

    model.at(t_ns, cameras) -> Gaussians                             numpy, ready to draw; len(model)
    model.advance(t_ns); model.keep(kept); model.insert(rows, t_ns)

One step of learning, with any loss of the planes, or its gradient by them [5, H, W]:

    drawing = model.draw(rasterizer, t_ns, camera)                   .planes [5, H, W], a tensor with a graph
    found = compare(drawing.planes, image, tissue, depth, unseen, LossWeights())
    drawing.differentiate(found.loss, found.weight)                  then .contribution, .spread [N]
    model.descend([drawing], Rates(rows, FieldRates()))              Adam

It imports torch, which takes a second. So only code that fits a model imports it, and only when it fits.

Imports engine, kernels and model.
"""

import sags_node.kernels.threads  # noqa: F401 - in a node before torch, whose idle workers must not spin there
