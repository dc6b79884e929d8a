function example_spring(link)
% EXAMPLE_SPRING  A spring and a damper, whose stiffness (N/mm) and damping (N s/mm) a hilbo session chooses.
%
%   hilbo init spring.toml --parameter stiffness=0.1:2:N/mm --parameter damping=0.001:0.02:N.s/mm
%   hilbo doctor spring.toml --stimulus            % prints a link: measures how fast this program stops
%   example_spring('LINK-OF-THE-STIMULUS')
%
% MATLAB is no place for a loop at 1 kHz: the force is the business of a controller with a watchdog of its own, and this
% program only hands the two numbers over (here to nobody: it writes down when there would be a force, and when none).

  fresh = tic;                                       % of the finger that is simulated
  set_spring(0, 0);
  stimulus = hilbo_stimulus(link, 'example_spring.m', '1', 'force', true, ...
                            'go_neutral', @() set_spring(0, 0), 'neutral_within_s', 0.1);
  ends = onCleanup(@() stimulus.close());
  while true
    stimulus.contact = mod(toc(fresh), 0.6) > 0.4;   % a finger that touches for 0.2 s every 0.6 s; yours is measured
    order = stimulus.next(0.05);
    if isempty(order)
      continue
    end
    if ~strcmp(order.what, 'present')
      set_spring(0, 0);
      stimulus.neutral();
    elseif strcmp(order.show, 'reference')
      set_spring(0.8, 0.005);
      stimulus.presented();
    else
      set_spring(order.values('stiffness'), order.values('damping'));
      stimulus.presented();
    end
  end
end

function set_spring(stiffness, damping) %#ok<INUSD>
% To the controller; on stderr when the spring comes and goes, with the time in s since 1970 (of a clock set to UTC).
  persistent pushes
  if isempty(pushes), pushes = false; end
  if (stiffness > 0) ~= pushes
    pushes = stiffness > 0;
    words = {'neutral', 'force'};
    fprintf(2, '%.3f %s\n', (now() - 719529) * 86400, words{1 + pushes});
  end
end
